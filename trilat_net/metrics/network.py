"""What links and loops did, as `analysis` defines it: one line of it per quantity.

Law: no definition of its own; docs/definitions.md has them.
"""

from ..analysis.link_use import LinkUse
from ..analysis.vitals import site_facts
from ..log.reader import Log
from .said import Facts, Said, said, unsaid

LINK = ("age_mean_ms", "age_p99_ms", "age_max_ms", "silence_ms", "loss", "burst", "late_samples")
NO_CLOCK = "no clock was read"
SITE = ("late_p99_us", "late_max_us", "busy_p99_us", "overruns", "missing")


def of_link(use: LinkUse) -> Facts:
    """Returns effective delay, loss and bursts of a link."""
    age, never = use.age_ms, "no sample ever came into use"
    ages = {
        "age_mean_ms": said(age.mean if age else None, never),
        "age_p99_ms": said(age.p99 if age else None, never),
        "age_max_ms": said(age.max if age else None, never),
        "silence_ms": said(use.silence_ms, never),
    }
    unknown = "of no sample it is known whether it came"
    lost = Said(None, "nothing was lost", applies=False) if use.loss == 0.0 else said(use.burst, unknown)
    return {
        **ages,
        "loss": said(use.loss, unknown),
        "burst": lost,
        "late_samples": said(use.counts.late if use.counts else None, f"no records of {use.site}"),
    }


def of_loop(log: Log, site: str) -> Facts:
    """Returns lateness, computing time and overruns of a site's loop, and its missing records."""
    missing = {"missing": said(log.missing(site))}
    if log.driver != "live":
        return {**unsaid(SITE[:-1], NO_CLOCK, applies=False), **missing}
    if not len(log[site]):
        return {**unsaid(SITE[:-1], f"no records of {site}"), **missing}
    facts = site_facts(log, site)
    busy = facts["busy_us"]
    return {
        "late_p99_us": said(facts["late_us"]["p99"]),
        "late_max_us": said(facts["late_us"]["max"]),
        "busy_p99_us": said(busy["p99"]) if busy else Said(None, "no second record"),
        "overruns": said(facts["overruns"]),
        **missing,
    }
