"""Summary of a log for programs: the content of `summary.json`.

Invariant: keys end in their unit; a quantity that the log does not determine is null, never NaN.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from ..log.log_reader import Log
from ..log.site_log import SiteLog
from ..scenario.expect import END_WINDOW_S
from . import site_signals
from .health import PERCENTILES, JsonObject, count_overruns, made_ticks, percentiles, summarise_clock
from .link_summary import LinkSummary, ValueStatistics, summarise_links
from .timeline import diverged_at_s, find_mode_intervals, list_changes


def summarise_run(log: Log, twin: Log | None = None) -> JsonObject:
    """Returns the numbers of a log, ready for JSON; of torn, short and empty ones too.

    Args:
        log: the log.
        twin: the same experiment without operators, or None.
    """
    sites = {name: _site(log, name, twin) for name in log.sites}
    settled = [site["settle_s"] for site in sites.values()]
    largest = [site["max_error_end_rad"] for site in sites.values() if site["max_error_end_rad"] is not None]
    return {
        "scenario": _scenario(log),
        "session": {**log.session, "complete": log.complete},
        "diverged": any(site["diverged_at_s"] is not None for site in sites.values()),
        "settle_s": None if None in settled else max(settled),
        "settle_below_rad": site_signals.SETTLED_ERROR_RAD,
        "max_error_end_rad": max(largest, default=None),
        "records": sum(site["records"] for site in sites.values()),
        "missing": sum(site["missing"] for site in sites.values()),
        "sites": sites,
        "links": {use.name: _link(log, use) for use in summarise_links(log)},
        "changes": [
            {
                "at_s": changed.change.at_s,
                "about": changed.about,
                "to": changed.text,
                "site": changed.site,
                "taken_at_tick": changed.taken_at_tick,
            }
            for changed in list_changes(log)
        ],
    }


def _scenario(log: Log) -> JsonObject:
    scenario = log.scenario
    return {
        "name": scenario.name,
        "title": scenario.title,
        "sha256": scenario.sha256,
        "duration_s": scenario.duration_s,
        "seed": scenario.seed,
        "scheme": scenario.scheme,
        "sites": list(scenario.names),
        "delay_ms": {name: _known(link.moments().mean_ms) for name, link in scenario.links.items()},
        "dominance": scenario.dominance,
        "assumed": list(scenario.assumed),
    }


def _site(log: Log, name: str, twin: Log | None) -> JsonObject:
    part, spec = log[name], log.scenario.sites[name]
    made, expected = made_ticks(log, name), log.scenario.ticks(name)
    late, busy = {"p50": 50.0, "p99": 99.0, "p99_9": 99.9, "max": 100.0}, PERCENTILES
    at_limit = np.abs(site_signals.controller_torques(part)) >= spec.limits.tau_limit_nm
    return {
        "role": spec.role,
        "rate_hz": spec.rate_hz,
        "records": len(part),
        "expected_ticks": expected,
        "made_ticks": made,
        "missing": max(0, (expected if made is None else made) - len(part)),
        "diverged_at_s": diverged_at_s(part),
        "modes": [span._asdict() for span in find_mode_intervals(part)],
        **_motion(part),
        "peak_tau_nm": _largest(site_signals.controller_torques(part)),
        "saturated_ticks": int(np.count_nonzero(at_limit.any(axis=1))),
        "late_us": percentiles(part.late_us, late) or dict.fromkeys(late),
        "busy_us": percentiles(part.busy_us, busy) or dict.fromkeys(busy),
        "overruns": count_overruns(part),
        **_displacement(log, twin, name),
    }


def _motion(part: SiteLog) -> JsonObject:
    errors = site_signals.joint_errors(part)
    end = part.t_s > part.t_s[-1] - END_WINDOW_S if len(part) else np.zeros(0, dtype=bool)
    angles = site_signals.joint_angles(part)
    return {
        "q_end_rad": angles[-1].tolist() if len(part) else None,
        "max_error_rad": _largest(errors),
        "max_error_end_rad": _largest(errors[end]),
        "settle_s": site_signals.settling_time_s(part),
    }


def _link(log: Log, use: LinkSummary) -> JsonObject:
    counts, clock = use.counts, summarise_clock(log, use.peer, use.site)
    return {
        "delay_ms": _known(use.stated[0].link.moments().mean_ms),
        "stated": [
            {
                "from_s": state.from_s,
                "link": state.link.describe(),
                "mean_ms": _known(state.link.moments().mean_ms),
                "deviation_ms": _known(state.link.moments().deviation_ms),
            }
            for state in use.stated
        ],
        "drawn_ms": use.drawn_ms._asdict() if use.drawn_ms else None,
        "age_ms": use.age_ms._asdict() if use.age_ms else dict.fromkeys(ValueStatistics._fields),
        "ages": use.ages._asdict() if use.ages else None,
        "first_use_s": use.first_use_s,
        "ticks_without_new": use.ticks_without_new,
        "silence_ms": use.silence_ms,
        "samples": counts._asdict() if counts else None,
        "late_samples": counts.late if counts else None,
        "duplicate_samples": counts.duplicate if counts else None,
        "loss": use.loss,
        "burst": use.burst,
        "one_way_us": use.one_way_us._asdict() if use.one_way_us else None,
        "clock": clock._asdict() if clock else None,
    }


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _displacement(log: Log, twin: Log | None, name: str) -> JsonObject:
    """Returns how far operators moved a site, per joint: at most, and at the last tick of both runs."""
    if twin is None:
        return {"hands_moved_max_rad": None, "hands_moved_end_rad": None}
    moved = site_signals.operator_displacement(log, twin, name)[2]
    return {
        "hands_moved_max_rad": np.abs(moved).max(axis=0).tolist() if len(moved) else None,
        "hands_moved_end_rad": moved[-1].tolist() if len(moved) else None,
    }


def _largest(values: ArrayLike) -> float | None:
    array = np.abs(np.asarray(values))
    return float(array.max()) if array.size else None
