"""Metrics of links and of the loops of sites.

Invariant: they add no definition to those of docs/definitions.md.
"""

from ..file_overview import describe_site_health
from ..run_view import RunView
from .measures import LOOP, NETWORK, Metric, MetricValues, Quantity, measures, metric, unavailable


@measures(
    "link",
    NETWORK,
    Quantity("age_mean_ms", "effective delay, mean", "ms"),
    Quantity("age_p99_ms", "effective delay, p99", "ms"),
    Quantity("age_max_ms", "effective delay, largest", "ms"),
    Quantity("silence_ms", "longest silence", "ms"),
    Quantity("loss", "loss"),
    Quantity("burst", "lost in a row, mean"),
    Quantity("late_samples", "late samples", "", "sum"),
)
def measure_network(view: RunView, link: str) -> MetricValues:
    """Returns effective delay, loss and bursts of a link."""
    use = view.links[link]
    age, never = use.age_ms, "no sample ever came into use"
    unknown = "of no sample it is known whether it came"
    lossless = Metric(None, "nothing was lost", applies=False)
    return {
        "age_mean_ms": metric(age.mean if age else None, never),
        "age_p99_ms": metric(age.p99 if age else None, never),
        "age_max_ms": metric(age.max if age else None, never),
        "silence_ms": metric(use.silence_ms, never),
        "loss": metric(use.loss, unknown),
        "burst": lossless if use.loss == 0.0 else metric(use.burst, unknown),
        "late_samples": metric(use.counts.late if use.counts else None, f"no records of {use.site}"),
    }


@measures(
    "site",
    LOOP,
    Quantity("late_p99_us", "lateness, p99", "us"),
    Quantity("late_max_us", "lateness, largest", "us"),
    Quantity("busy_p99_us", "computing time, p99", "us"),
    Quantity("overruns", "overruns", "", "sum"),
    Quantity("missing", "missing records", "", "sum"),
)
def measure_loop(view: RunView, site: str) -> MetricValues:
    """Returns lateness, computing time and overruns of a site's loop, and its missing records."""
    log = view.log
    missing = {"missing": metric(log.missing(site))}
    if log.driver != "live":
        return unavailable(LOOP, "no clock was read", applies=False) | missing
    if not len(log[site]):
        return unavailable(LOOP, f"no records of {site}") | missing
    health = describe_site_health(log, site)
    busy = health["busy_us"]
    return {
        "late_p99_us": metric(health["late_us"]["p99"]),
        "late_max_us": metric(health["late_us"]["max"]),
        "busy_p99_us": metric(busy["p99"] if busy else None, "no second record"),
        "overruns": metric(health["overruns"]),
        **missing,
    }
