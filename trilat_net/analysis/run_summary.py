"""Summary of a log for programs: the content of `summary.json`.

Invariant: keys end in their unit; a quantity that the log does not determine is null, never NaN.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..log.log_reader import Log
from ..log.site_log import SiteLog
from ..scenario.expect import END_WINDOW_S
from . import site_signals
from .health import summarise_clock
from .link_summary import LinkSummary, ValueStatistics, summarise_links
from .timeline import AppliedChange, StatedModel, diverged_at_s, find_mode_intervals, list_changes

JsonObject = dict[str, Any]


def summarise_run(log: Log, twin: Log | None = None) -> JsonObject:
    """Returns what can be said of a log in numbers, ready for JSON.

    Args:
        log: the log; torn, short and empty ones too.
        twin: the same experiment with nobody at the arms, or None.
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
        "changes": [_changed(changed) for changed in list_changes(log)],
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
    return {
        "role": spec.role,
        "rate_hz": spec.rate_hz,
        **_records(log, part),
        **_motion(part),
        "peak_tau_nm": _largest(site_signals.controller_torques(part)),
        "saturated_ticks": _ticks_at_limit(part, spec.limits.tau_limit_nm),
        "late_us": _spread(part.late_us, {"p50": 50.0, "p99": 99.0, "p99_9": 99.9, "max": 100.0}),
        "busy_us": _spread(part.busy_us, {"p50": 50.0, "p99": 99.0, "max": 100.0}),
        "overruns": int(np.count_nonzero(part.late_us >= 1e6 / spec.rate_hz)),
        **_moved(log, twin, name),
    }


def _records(log: Log, part: SiteLog) -> JsonObject:
    """Counts records; what is missing is missing of the ticks that the site said it made, if it said so."""
    made = next((e.ticks for e in log.events if e.kind == "end" and e.member == part.name), None)
    expected = log.scenario.ticks(part.name)
    return {
        "records": len(part),
        "expected_ticks": expected,
        "made_ticks": made,
        "missing": max(0, (expected if made is None else made) - len(part)),
        "diverged_at_s": diverged_at_s(part),
        "modes": [span._asdict() for span in find_mode_intervals(part)],
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
    """Returns what can be said of a link."""
    counts, clock = use.counts, summarise_clock(log, use.peer, use.site)
    return {
        "delay_ms": _known(use.stated[0].link.moments().mean_ms),
        "stated": [_stated(state) for state in use.stated],
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


def _stated(state: StatedModel) -> JsonObject:
    mean_ms, deviation_ms = state.link.moments()
    return {
        "from_s": state.from_s,
        "link": state.link.describe(),
        "mean_ms": _known(mean_ms),
        "deviation_ms": _known(deviation_ms),
    }


def _changed(changed: AppliedChange) -> JsonObject:
    return {
        "at_s": changed.change.at_s,
        "about": changed.about,
        "to": changed.text,
        "site": changed.site,
        "taken_at_tick": changed.taken_at_tick,
    }


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _moved(log: Log, twin: Log | None, name: str) -> JsonObject:
    """Returns how far the hands moved a site, per joint: at most, and at the last tick of both runs."""
    if twin is None:
        return {"hands_moved_max_rad": None, "hands_moved_end_rad": None}
    moved = site_signals.operator_displacement(log, twin, name)[2]
    return {
        "hands_moved_max_rad": np.abs(moved).max(axis=0).tolist() if len(moved) else None,
        "hands_moved_end_rad": moved[-1].tolist() if len(moved) else None,
    }


def _ticks_at_limit(part: SiteLog, limit_nm: float) -> int:
    return int(np.count_nonzero(np.any(np.abs(site_signals.controller_torques(part)) >= limit_nm, axis=1)))


def _largest(values: ArrayLike) -> float | None:
    array = np.abs(np.asarray(values))
    return float(array.max()) if array.size else None


def _spread(values: ArrayLike, percentiles: dict[str, float]) -> dict[str, float | None]:
    array = np.asarray(values)
    if not array.size:
        return dict.fromkeys(percentiles)
    return dict(zip(percentiles, np.percentile(array, list(percentiles.values())).tolist(), strict=True))
