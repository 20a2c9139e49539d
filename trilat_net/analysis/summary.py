"""A log in numbers, for programs: what `summary.json` holds.

Law: keys end in their unit; what a log cannot tell is null, never a guess and never NaN.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..log.reader import Log, SiteLog
from . import quantities
from .clocks import clock_use
from .happenings import Changed, Stated, changes, diverged_at_s, spans
from .link_use import LinkUse, Spread, link_uses

LAST_S = 1.0
"""Length of the end of a run that `max_error_end_rad` looks at, s."""

Facts = dict[str, Any]


def summarise(log: Log, twin: Log | None = None) -> Facts:
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
        "settle_below_rad": quantities.SETTLED_RAD,
        "max_error_end_rad": max(largest, default=None),
        "records": sum(site["records"] for site in sites.values()),
        "missing": sum(site["missing"] for site in sites.values()),
        "sites": sites,
        "links": {use.name: _link(log, use) for use in link_uses(log)},
        "changes": [_changed(changed) for changed in changes(log)],
    }


def _scenario(log: Log) -> Facts:
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


def _site(log: Log, name: str, twin: Log | None) -> Facts:
    part, spec = log[name], log.scenario.sites[name]
    return {
        "role": spec.role,
        "rate_hz": spec.rate_hz,
        **_records(log, part),
        **_motion(part),
        "peak_tau_nm": _largest(quantities.control_torques(part)),
        "saturated_ticks": _ticks_at_limit(part, spec.limits.tau_limit_nm),
        "late_us": _spread(part.late_us, {"p50": 50.0, "p99": 99.0, "p99_9": 99.9, "max": 100.0}),
        "busy_us": _spread(part.busy_us, {"p50": 50.0, "p99": 99.0, "max": 100.0}),
        "overruns": int(np.count_nonzero(part.late_us >= 1e6 / spec.rate_hz)),
        **_moved(log, twin, name),
    }


def _records(log: Log, part: SiteLog) -> Facts:
    """Counts records; what is missing is missing of the ticks that the site said it made, if it said so."""
    made = next((e.ticks for e in log.events if e.kind == "end" and e.member == part.name), None)
    expected = log.scenario.ticks(part.name)
    return {
        "records": len(part),
        "expected_ticks": expected,
        "made_ticks": made,
        "missing": max(0, (expected if made is None else made) - len(part)),
        "diverged_at_s": diverged_at_s(part),
        "modes": [span._asdict() for span in spans(part)],
    }


def _motion(part: SiteLog) -> Facts:
    errors = quantities.errors(part)
    end = part.t_s > part.t_s[-1] - LAST_S if len(part) else np.zeros(0, dtype=bool)
    angles = quantities.angles(part)
    return {
        "q_end_rad": angles[-1].tolist() if len(part) else None,
        "max_error_rad": _largest(errors),
        "max_error_end_rad": _largest(errors[end]),
        "settle_s": quantities.settle_s(part),
    }


def _link(log: Log, use: LinkUse) -> Facts:
    """Returns what can be said of a link."""
    counts, clock = use.counts, clock_use(log, use.peer, use.site)
    return {
        "delay_ms": _known(use.stated[0].link.moments().mean_ms),
        "stated": [_stated(state) for state in use.stated],
        "drawn_ms": use.drawn_ms._asdict() if use.drawn_ms else None,
        "age_ms": use.age_ms._asdict() if use.age_ms else dict.fromkeys(Spread._fields),
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


def _stated(state: Stated) -> Facts:
    mean_ms, deviation_ms = state.link.moments()
    return {
        "from_s": state.from_s,
        "link": state.link.describe(),
        "mean_ms": _known(mean_ms),
        "deviation_ms": _known(deviation_ms),
    }


def _changed(changed: Changed) -> Facts:
    return {
        "at_s": changed.change.at_s,
        "about": changed.about,
        "to": changed.text,
        "site": changed.site,
        "taken_at_tick": changed.taken_at_tick,
    }


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _moved(log: Log, twin: Log | None, name: str) -> Facts:
    """Returns how far the hands moved a site, per joint: at most, and at the last tick of both runs."""
    if twin is None:
        return {"hands_moved_max_rad": None, "hands_moved_end_rad": None}
    moved = quantities.moved_by_hands(log, twin, name)[2]
    return {
        "hands_moved_max_rad": np.abs(moved).max(axis=0).tolist() if len(moved) else None,
        "hands_moved_end_rad": moved[-1].tolist() if len(moved) else None,
    }


def _ticks_at_limit(part: SiteLog, limit_nm: float) -> int:
    return int(np.count_nonzero(np.any(np.abs(quantities.control_torques(part)) >= limit_nm, axis=1)))


def _largest(values: ArrayLike) -> float | None:
    array = np.abs(np.asarray(values))
    return float(array.max()) if array.size else None


def _spread(values: ArrayLike, percentiles: dict[str, float]) -> dict[str, float | None]:
    array = np.asarray(values)
    if not array.size:
        return dict.fromkeys(percentiles)
    return dict(zip(percentiles, np.percentile(array, list(percentiles.values())).tolist(), strict=True))
