"""Health of a session, its loops, links and clocks, in numbers that need no re-execution.

Invariant: keys end in their unit; a quantity that the log does not determine is None, never NaN. Clock
estimates are those in force while the session ran, without later improvement.
"""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..core.ticks import NS_PER_S
from ..log.log_reader import Log
from ..log.site_log import SiteLog
from .json_values import JsonObject
from .link_summary import ONE_WAY_SCHEMA_VERSION, sample_ages_ns


class ClockSummary(NamedTuple):
    """The clock of a link's sender against the receiver's: `clock.*` of docs/definitions.md.

    `drift` and `rtt_min_us` are None without an estimate; `faults` says that a clock has stepped.
    """

    offset_us: int
    offset_first_us: int
    drift_ppm: float | None
    drift_bound_ppm: float | None
    bound_us: int
    bound_p50_us: float
    bound_max_us: int
    rtt_min_us: int | None
    faults: int

    @property
    def shared(self) -> bool:
        """True if both ends read one and the same clock."""
        return self.bound_max_us == 0 and self.offset_us == 0


def summarise_clock(log: Log, peer: str, site: str) -> ClockSummary | None:
    """Returns the estimates of a peer's clock at a site; None if nothing was measured, as in virtual time."""
    stats = [stats for stats in log.link_stats(site) if peer in stats.offset_us]
    if not stats:
        return None
    bounds = [each.bound_us.get(peer, 0) for each in stats]
    trips = [trip for each in stats if (trip := each.rtt_us.get(peer, -1)) >= 0]
    drifts = [e for e in log.events if (e.kind, e.member, e.about) == ("clock", site, peer)]
    return ClockSummary(
        offset_us=stats[-1].offset_us[peer],
        offset_first_us=stats[0].offset_us[peer],
        drift_ppm=drifts[-1].drift_ppb / 1e3 if drifts else None,
        drift_bound_ppm=drifts[-1].drift_bound_ppb / 1e3 if drifts else None,
        bound_us=bounds[-1],
        bound_p50_us=float(np.median(bounds)),
        bound_max_us=max(bounds),
        rtt_min_us=min(trips, default=None),
        faults=stats[-1].clock_faults.get(peer, 0),
    )


_PROVENANCE = ("commit", "commit_dirty", "fingerprint", "platform", "python", "schema_version")
_LAST_EPOCH_NS = 253_402_300_799 * NS_PER_S  # the year 9999


def describe_session(log: Log) -> JsonObject:
    """Returns the facts of a log's session."""
    session, scenario = log.session, log.scenario
    epoch_ns = _number(session.get("epoch_unix_ns", ""))
    seconds = [int(log[site].tick[-1]) / log[site].rate_hz for site in log.sites if len(log[site])]
    began_utc = None
    if log.driver == "live" and epoch_ns is not None:
        began_at = datetime.fromtimestamp(min(epoch_ns, _LAST_EPOCH_NS) // NS_PER_S, UTC)
        began_utc = began_at.strftime("%Y-%m-%d %H:%M:%S")
    return {
        "session": session["session"],
        "driver": log.driver,
        "complete": log.complete,
        "began_utc": began_utc,
        "epoch_unix_ns": epoch_ns,
        "recorded_s": max(seconds, default=0.0),
        "ended": {event.member: event.ticks for event in log.events if event.kind == "end"},
        "scenario": {
            "name": scenario.name,
            "title": scenario.title,
            "sha256": log.scenario_sha256,
            "as_named": log.scenario_sha256 == session.get("scenario_sha256"),
            "duration_s": scenario.duration_s,
            "seed": scenario.seed,
            "sites": list(log.sites),
        },
        **{key: session.get(key) for key in _PROVENANCE},
        "versions": {key[8:]: value for key, value in session.items() if key.startswith("version_")},
        "accounts": log.accounts,
    }


def describe_site_health(log: Log, site: str) -> JsonObject:
    """Returns the facts of a site's records and of its loop."""
    part, spec, timed = log[site], log.scenario.sites[site], log.driver == "live"
    return {
        "role": spec.role,
        "rate_hz": spec.rate_hz,
        "records": len(part),
        "made_ticks": made_ticks(log, site),
        "expected_ticks": log.scenario.ticks(site),
        "missing": log.missing(site),
        "late_us": percentiles(part.late_us) if timed else None,
        "busy_us": percentiles(part.busy_us) if timed else None,
        "overruns": count_overruns(part) if timed else None,
    }


def describe_link_health(log: Log, peer: str, site: str) -> JsonObject:
    """Returns the facts of a directed link, peer -> site."""
    clock = summarise_clock(log, peer, site)
    stats = log.link_stats(site)[-1:]
    counts = ("accepted", "lost", "late", "superseded", "duplicate", "refused")
    one_way_us = np.zeros(0, dtype=np.int64)  # none is measured in virtual time
    version = _number(log.session.get("schema_version", "")) or 0
    if log.driver == "live" and version >= ONE_WAY_SCHEMA_VERSION:
        came = log[site].arrivals[1]
        one_way_us = came[came[:, 0] == log[site].peers.index(peer), 2]
    return {
        "stated": log.scenario.links[f"{peer}->{site}"].describe(),
        "age_ms": percentiles(sample_ages_ns(log, peer, site), unit=1e6),
        "one_way_ms": percentiles(one_way_us, unit=1e3),
        "clock_offset_us": None if clock is None else clock.offset_us,
        "clock_bound_us": None if clock is None else clock.bound_us,
        **{name: getattr(stats[0], name).get(peer) if stats else None for name in counts},
    }


PERCENTILES = {"p50": 50.0, "p99": 99.0, "max": 100.0}


def percentiles(
    values: ArrayLike, shares: Mapping[str, float] = PERCENTILES, unit: float = 1.0
) -> dict[str, float] | None:
    """Returns percentiles by name, in multiples of a unit; None of no values."""
    array = np.asarray(values)
    if not array.size:
        return None
    found = (np.percentile(array, list(shares.values())) / unit).tolist()
    return dict(zip(shares, found, strict=True))


def made_ticks(log: Log, site: str) -> int | None:
    """Returns the number of ticks that a site made, by its own event; None without one."""
    return next((event.ticks for event in log.events if (event.kind, event.member) == ("end", site)), None)


def count_overruns(part: SiteLog) -> int:
    """Returns how many ticks began later than a whole period."""
    return int(np.count_nonzero(part.late_us >= 1e6 / part.rate_hz))


def _number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else None
