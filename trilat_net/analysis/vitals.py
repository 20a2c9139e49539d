"""The session of a log at a glance: its sites' loops and its links, in numbers that need no execution.

Law: keys end in their unit; what a log cannot tell is None, never a guess and never NaN.
"""

from datetime import UTC, datetime
from typing import Any

import numpy as np

from ..core.grid import NS_PER_S
from ..log.reader import Ints, Log
from .clocks import clock_use
from .link_use import ONE_WAY_SINCE, ages_ns

Facts = dict[str, Any]

_PROVENANCE = ("commit", "commit_dirty", "fingerprint", "platform", "python", "schema_version")
_LAST_EPOCH_NS = 253_402_300_799 * NS_PER_S  # the year 9999


def session_facts(log: Log) -> Facts:
    """Returns what a log says of its session."""
    said, scenario = log.session, log.scenario
    epoch_ns = _number(said.get("epoch_unix_ns", ""))
    seconds = [int(log[site].tick[-1]) / log[site].rate_hz for site in log.sites if len(log[site])]
    live = log.driver == "live" and epoch_ns is not None
    return {
        "session": said["session"],
        "driver": log.driver,
        "complete": log.complete,
        "began_utc": _date(epoch_ns) if live and epoch_ns is not None else None,
        "epoch_unix_ns": epoch_ns,
        "recorded_s": max(seconds, default=0.0),
        "ended": {event.member: event.ticks for event in log.events if event.kind == "end"},
        "scenario": {
            "name": scenario.name,
            "title": scenario.title,
            "sha256": log.scenario_sha256,
            "as_named": log.scenario_sha256 == said.get("scenario_sha256"),
            "duration_s": scenario.duration_s,
            "seed": scenario.seed,
            "sites": list(log.sites),
        },
        **{key: said.get(key) for key in _PROVENANCE},
        "versions": {
            key.removeprefix("version_"): value for key, value in said.items() if key.startswith("version_")
        },
        "accounts": log.accounts,
    }


def site_facts(log: Log, site: str) -> Facts:
    """Returns what a log says of a site's records and of its loop."""
    part, spec = log[site], log.scenario.sites[site]
    made = next((event.ticks for event in log.events if (event.kind, event.member) == ("end", site)), None)
    timed = log.driver == "live"
    return {
        "role": spec.role,
        "rate_hz": spec.rate_hz,
        "records": len(part),
        "made_ticks": made,
        "expected_ticks": log.scenario.ticks(site),
        "missing": log.missing(site),
        "late_us": _spread(part.late_us, 1.0) if timed else None,
        "busy_us": _spread(part.busy_us, 1.0) if timed else None,
        "overruns": int(np.count_nonzero(part.late_us >= 1e6 / spec.rate_hz)) if timed else None,
    }


def link_facts(log: Log, peer: str, site: str) -> Facts:
    """Returns what a log says of a directed link, peer -> site."""
    clock = clock_use(log, peer, site)
    stats = log.link_stats(site)[-1:]
    counts = ("accepted", "lost", "late", "superseded", "duplicate", "refused")
    return {
        "stated": log.scenario.links[f"{peer}->{site}"].describe(),
        "age_ms": _spread(ages_ns(log, peer, site), 1e6),
        "one_way_ms": _spread(_one_way_us(log, peer, site), 1e3),
        "clock_offset_us": None if clock is None else clock.offset_us,
        "clock_bound_us": None if clock is None else clock.bound_us,
        **{name: getattr(stats[0], name).get(peer) if stats else None for name in counts},
    }


def _one_way_us(log: Log, peer: str, site: str) -> Ints:
    """Returns the measured one-way delay of everything that came over a link, us; none in virtual time."""
    part = log[site]
    version = _number(log.session.get("schema_version", "")) or 0
    if log.driver != "live" or version < ONE_WAY_SINCE:
        return np.zeros(0, dtype=np.int64)
    _, came = part.arrivals
    delays: Ints = came[came[:, 0] == part.peers.index(peer), 2]
    return delays


def _spread(values: Ints, unit: float) -> Facts | None:
    """Returns median, 99th percentile and largest, in units of so many; None where there is nothing."""
    if not len(values):
        return None
    p50, p99, largest = (np.percentile(values, (50.0, 99.0, 100.0)) / unit).tolist()
    return {"p50": p50, "p99": p99, "max": largest}


def _number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else None


def _date(epoch_ns: int) -> str:
    at_s = min(epoch_ns, _LAST_EPOCH_NS) // NS_PER_S
    return datetime.fromtimestamp(at_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
