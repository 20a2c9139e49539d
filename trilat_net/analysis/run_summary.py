"""Summary of a log for programs: the content of `summary.json`.

Invariant: keys end in their unit; a quantity that the log does not determine is null, never NaN.
"""

import numpy as np
from numpy.typing import ArrayLike

from ..log.log_reader import Log
from ..results import JsonObject, finite_or_none
from ..scenario.expect import END_WINDOW_S
from . import file_overview
from .link_summary import LinkSummary, ValueStatistics, summarise_clock, summarise_links
from .site_signals import SETTLED_ERROR_RAD, operator_displacement, settling_time_of_all_s, settling_time_s
from .timeline import find_mode_intervals, list_changes


def summarise_run(log: Log, twin: Log | None = None) -> JsonObject:
    """Returns the numbers of a log, torn, short and empty ones too; `twin` is the run without operators."""
    sites = {name: _describe_site(log, name, twin) for name in log.sites}
    settled = [site["settle_s"] for site in sites.values()]
    largest = [site["max_error_end_rad"] for site in sites.values() if site["max_error_end_rad"] is not None]
    return {
        "scenario": _describe_scenario(log),
        "session": {**log.session, "complete": log.complete},
        "diverged": any(site["diverged_at_s"] is not None for site in sites.values()),
        "settle_s": settling_time_of_all_s(settled),
        "settle_below_rad": SETTLED_ERROR_RAD,
        "max_error_end_rad": max(largest, default=None),
        "records": sum(site["records"] for site in sites.values()),
        "missing": sum(site["missing"] for site in sites.values()),
        "sites": sites,
        "links": {use.name: _describe_link(log, use) for use in summarise_links(log)},
        "changes": [
            {"at_s": one.change.at_s, "about": one.about, "to": one.text}
            | {"site": one.site, "taken_at_tick": one.taken_at_tick}
            for one in list_changes(log)
        ],
    }


def _describe_scenario(log: Log) -> JsonObject:
    scenario = log.scenario
    keys = ("name", "title", "sha256", "duration_s", "seed", "scheme")
    return {
        **{key: getattr(scenario, key) for key in keys},
        "sites": list(scenario.names),
        "delay_ms": {name: finite_or_none(link.moments().mean_ms) for name, link in scenario.links.items()},
        "dominance": scenario.dominance,
        "assumed": list(scenario.assumed),
    }


def _describe_site(log: Log, name: str, twin: Log | None) -> JsonObject:
    part, spec = log[name], log.scenario.sites[name]
    end = part.t_s > part.t_s[-1] - END_WINDOW_S if len(part) else np.zeros(0, dtype=bool)
    moved = operator_displacement(log, twin, name)[2] if twin is not None else part.q[:0]
    made, expected = file_overview.made_ticks(log, name), log.scenario.ticks(name)
    late, busy = {"p50": 50.0, "p99": 99.0, "p99_9": 99.9, "max": 100.0}, file_overview.PERCENTILES
    at_limit = np.abs(part.tau) >= spec.limits.tau_limit_nm
    return {
        "role": spec.role,
        "rate_hz": spec.rate_hz,
        "records": len(part),
        "expected_ticks": expected,
        "made_ticks": made,
        "missing": max(0, (expected if made is None else made) - len(part)),
        "diverged_at_s": part.diverged_s,
        "modes": [span._asdict() for span in find_mode_intervals(part)],
        "q_end_rad": part.q[-1].tolist() if len(part) else None,
        "max_error_rad": _largest(part.e),
        "max_error_end_rad": _largest(part.e[end]),
        "settle_s": settling_time_s(part),
        "peak_tau_nm": _largest(part.tau),
        "saturated_ticks": int(np.count_nonzero(at_limit.any(axis=1))),
        "late_us": file_overview.percentiles(part.late_us, late) or dict.fromkeys(late),
        "busy_us": file_overview.percentiles(part.busy_us, busy) or dict.fromkeys(busy),
        "overruns": file_overview.count_overruns(part),
        "hands_moved_max_rad": np.abs(moved).max(axis=0).tolist() if len(moved) else None,
        "hands_moved_end_rad": moved[-1].tolist() if len(moved) else None,
    }


def _describe_link(log: Log, use: LinkSummary) -> JsonObject:
    counts, clock = use.counts, summarise_clock(log, use.peer, use.site)
    return {
        "delay_ms": finite_or_none(use.stated[0].link.moments().mean_ms),
        "stated": [
            {
                "from_s": state.from_s,
                "link": state.link.describe(),
                "mean_ms": finite_or_none(state.link.moments().mean_ms),
                "deviation_ms": finite_or_none(state.link.moments().deviation_ms),
            }
            for state in use.stated
        ],
        "drawn_ms": use.drawn_ms._asdict() if use.drawn_ms else None,
        "age_ms": use.age_ms._asdict() if use.age_ms else dict.fromkeys(ValueStatistics._fields),
        "ages": use.ages._asdict() if use.ages else None,
        **{key: getattr(use, key) for key in ("first_use_s", "ticks_without_new", "silence_ms")},
        "samples": counts._asdict() if counts else None,
        "late_samples": counts.late if counts else None,
        "duplicate_samples": counts.duplicate if counts else None,
        **{key: getattr(use, key) for key in ("loss", "burst")},
        "one_way_us": use.one_way_us._asdict() if use.one_way_us else None,
        "clock": clock._asdict() if clock else None,
    }


def _largest(values: ArrayLike) -> float | None:
    array = np.abs(np.asarray(values))
    return float(array.max()) if array.size else None
