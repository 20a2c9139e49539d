"""Overview of MCAP files: layout, channels, gaps and message rates; of a trilat-net log also
its health.

That is: of its session, its loops, links and clocks, in numbers that need no re-execution.

Invariant: the inventory decodes no message, so any MCAP file has one, also where its log cannot
be opened; the overview then holds the reason. Gaps are counted only on channels with
consecutive numbers. Keys end in their unit; a quantity that the log does not determine is None,
never NaN.

The summary of a run is the content of `summary.json`; there too keys end in their unit, and
what the log does not determine is null.
"""

from array import array
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..core.ticks import NS_PER_S
from ..errors import LogError, count_nouns
from ..files import reading
from ..log.accounting import Account
from ..log.log_layout import SESSION
from ..log.log_reader import Log, open_log
from ..log.mcap_reader import ChannelInfo, McapReader, Progress, shift_progress
from ..log.site_log import SiteLog
from ..net import topics
from ..net.topics import count_messages, number_message
from ..results import JsonObject, Result, finite_or_none
from ..scenario.describe import list_arm_notes
from ..scenario.expect import END_WINDOW_S
from .link_summary import (
    ONE_WAY_SCHEMA_VERSION,
    LinkSummary,
    ValueStatistics,
    sample_ages_ns,
    summarise_clock,
    summarise_links,
)
from .site_signals import (
    SETTLED_ERROR_RAD,
    operator_displacement,
    settling_time_of_all_s,
    settling_time_s,
)
from .timeline import find_mode_intervals, list_changes

MOST_LISTED_GAPS = 1000
"""Gaps of a channel that are named."""


Absences = Mapping[str, Sequence[tuple[int, int]]]
"""Per site the ticks that it did not make, as (first, last)."""


class FileInventory:
    """Content of a file, or of the files of one log; `progress` gets the bytes read and those
    in all.

    Attributes:
        files: facts of every file, keys ending in their units.
        metadata: of all files, by name; of the last with a name.

    Raises:
        LogError: a file cannot be read, or is no MCAP file.
    """

    def __init__(self, paths: Sequence[Path], progress: Progress | None = None) -> None:
        self.files: list[JsonObject] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self._about: dict[str, ChannelInfo] = {}
        self._came: defaultdict[str, tuple[array[int], ...]] = (
            defaultdict(  # log time, sequence, size
                lambda: (array("Q"), array("Q"), array("Q"))
            )
        )
        total = sum(path.stat().st_size for path in paths if path.is_file())
        before = 0
        for path in paths:
            with reading(path) as stream:
                self._read(
                    path, McapReader(stream, str(path), shift_progress(progress, before, total))
                )
            before += path.stat().st_size

    def _read(self, path: Path, walk: McapReader) -> None:
        for topic, payload, log_ns, _, sequence in walk.messages():
            times, sequences, sizes = self._came[topic]
            times.append(log_ns)
            sequences.append(sequence)
            sizes.append(len(payload))
        self._about = {**walk.channels, **self._about}
        self.metadata.update(walk.metadata)
        self.files.append(
            {
                "path": path.as_posix(),
                "size_bytes": walk.size,
                "library": walk.library,
                "finished": walk.complete,
                "cut_off_at_byte": None if walk.torn is None else walk.torn.offset,
                "damaged": [part._asdict() for part in walk.damaged],
                "chunks": walk.chunks.total(),
                "compression": {name or "none": count for name, count in walk.chunks.items()},
                "packed_bytes": walk.packed_bytes,
                "unpacked_bytes": walk.unpacked_bytes,
                "attachments": {name: len(data) for name, data in walk.attachments.items()},
                "metadata": sorted(walk.metadata),
                "part": walk.metadata.get("trilat.part", {}),
            }
        )

    def channels(
        self, session: str, rates_hz: Mapping[str, int], absences: Absences
    ) -> dict[str, JsonObject]:
        """Returns the facts of every channel by topic; gaps of those of a session's sites."""
        names = [*self._about, *(topic for topic in self._came if topic not in self._about)]
        return {
            topic: self._channel(topic)
            | _numbers(
                topic=topic,
                sequence=self._came[topic][1],
                session=session,
                rates_hz=rates_hz,
                absences=absences,
            )
            for topic in names
        }

    def _channel(self, topic: str) -> JsonObject:
        about = self._about.get(
            topic,
            ChannelInfo(topic=topic, encoding="", schema="", schema_encoding="", metadata={}),
        )
        log_ns, _, sizes = (np.frombuffer(c, dtype=np.uint64) for c in self._came[topic])
        first_ns, last_ns = (
            (int(log_ns.min()), int(log_ns.max())) if len(log_ns) else (None, None)
        )
        span_s = 0.0 if first_ns is None or last_ns is None else (last_ns - first_ns) / NS_PER_S
        return {
            "messages": len(log_ns),
            "bytes": int(sizes.sum()),
            "rate_hz": (len(log_ns) - 1) / span_s if span_s else None,
            "first_log_time_ns": first_ns,
            "last_log_time_ns": last_ns,
            # in the order of the file
            "between_ms": compute_percentiles(
                np.diff(np.minimum(log_ns, (1 << 63) - 1).astype(np.int64)), unit=1e6
            ),
            "encoding": about.encoding,
            "schema": about.schema,
        }


def _numbers(
    topic: str,
    sequence: Sequence[int],
    session: str,
    rates_hz: Mapping[str, int],
    absences: Absences,
) -> JsonObject:
    """Returns the gaps of a channel with consecutive numbers; else None for each."""
    where = topics.parse_key(topic.removeprefix("/"))
    of_a_site = where is not None and where.session == session and where.member in rates_hz
    if where is None or not of_a_site or where.channel not in (topics.STATE, topics.LINK):
        return {"missing": None, "gaps": None, "duplicates": None}
    account = Account()
    channel = where.channel
    rate_hz = rates_hz[where.member]
    for tick in sequence:
        account.receive(number_message(channel, tick, rate_hz))
    for first, last in absences.get(where.member, ()):  # not made: they are not missing
        account.mark_unpublished(
            *(count_messages(channel, ticks, rate_hz) for ticks in (last + 1, first))
        )
    gaps = account.gaps[:MOST_LISTED_GAPS]
    return {"missing": account.missing, "gaps": gaps, "duplicates": account.duplicate}


@dataclass(frozen=True, repr=False)
class FileOverview(Result):
    """What a file, or the parts of one log, hold; see `info`."""

    facts: JsonObject

    def headline(self) -> str:
        """Returns which files, and how many messages."""
        messages = sum(channel["messages"] for channel in self.facts["channels"].values())
        return f"{', '.join(file['path'] for file in self.facts['files'])}: {count_nouns(messages, 'message')}"

    def to_dict(self) -> JsonObject:
        """Returns plain values, with the keys of `trilat log info --json`."""
        return self.facts

    def to_rows(self) -> list[JsonObject]:
        """Returns a row per channel."""
        return [
            {"topic": topic, **channel} for topic, channel in self.facts["channels"].items()
        ]


def info(*files: str | Path, progress: Progress | None = None) -> FileOverview:
    """Returns what an MCAP file holds, or the parts of one log; the command is `trilat log
    info`.

    `kind` is "trilat" for a log of ours that could be opened, else "mcap", with the reason in
    `problem`.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("short.mcap")
    >>> tn.info(path).to_dict()["sites"]["m"]["records"]
    100

    Raises:
        LogError: a file cannot be read, or is no MCAP file.
    """
    paths = [Path(file) for file in files]

    def report(half: int) -> Progress | None:
        return progress and (lambda done, total: progress(half * total + done, 2 * total))

    inventory = FileInventory(paths, report(0))
    facts: JsonObject = {
        "files": inventory.files,
        "kind": "mcap",
        "problem": None,
        "session": None,
    }
    facts |= {"sites": {}, "links": {}}
    name = ""
    rates_hz = {}
    absences = {}
    if SESSION in inventory.metadata:
        try:
            log = open_log(*paths, progress=report(1))
            facts |= {
                "kind": "trilat",
                "session": describe_session(log),
                "sites": {site: describe_site_health(log, site) for site in log.sites},
                "links": {
                    f"{peer}->{site}": describe_link_health(log, peer, site)
                    for site in log.sites
                    for peer in log[site].peers
                },
            }
            name = log.session["session"]
            absences = log.absences
            rates_hz = {site: log.scenario.sites[site].rate_hz for site in log.sites}
        except LogError as error:
            facts["problem"] = str(error)
    facts["channels"] = inventory.channels(name, rates_hz, absences)
    return FileOverview(facts)


_PROVENANCE = ("commit", "commit_dirty", "fingerprint", "platform", "python", "schema_version")
_LAST_EPOCH_NS = 253_402_300_799 * NS_PER_S  # the year 9999


def describe_session(log: Log) -> JsonObject:
    """Returns the facts of a log's session."""
    session = log.session
    scenario = log.scenario
    epoch_ns = _number(session.get("epoch_unix_ns", ""))
    seconds = [
        int(log[site].tick[-1]) / log[site].rate_hz for site in log.sites if len(log[site])
    ]
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
        "unknown_ends": list(log.unknown_ends),
        "scenario": {
            "name": scenario.name,
            "title": scenario.title,
            "sha256": log.scenario_sha256,
            "as_named": log.scenario_sha256 == session.get("scenario_sha256"),
            "duration_s": scenario.duration_s,
            "seed": scenario.seed,
            "sites": list(log.sites),
            "arms": list_arm_notes(scenario),
        },
        **{key: session.get(key) for key in _PROVENANCE},
        "versions": {
            key[8:]: value for key, value in session.items() if key.startswith("version_")
        },
        "accounts": log.accounts,
    }


def describe_site_health(log: Log, site: str) -> JsonObject:
    """Returns the facts of a site's records and of its loop."""
    part = log[site]
    spec = log.scenario.sites[site]
    timed = log.driver == "live"
    return {
        "role": spec.role,
        "rate_hz": spec.rate_hz,
        "records": len(part),
        "made_ticks": count_executed_ticks(log, site),
        "expected_ticks": log.scenario.ticks(site),
        "missing": log.missing(site),
        "late_us": compute_percentiles(part.late_us) if timed else None,
        "busy_us": compute_percentiles(part.busy_us) if timed else None,
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
        "age_ms": compute_percentiles(sample_ages_ns(log, peer, site), unit=1e6),
        "one_way_ms": compute_percentiles(one_way_us, unit=1e3),
        "clock_offset_us": None if clock is None else clock.offset_us,
        "clock_bound_us": None if clock is None else clock.bound_us,
        **{name: getattr(stats[0], name).get(peer) if stats else None for name in counts},
    }


PERCENTILES = {"p50": 50.0, "p99": 99.0, "max": 100.0}


def compute_percentiles(
    values: ArrayLike, shares: Mapping[str, float] = PERCENTILES, unit: float = 1.0
) -> dict[str, float] | None:
    """Returns percentiles by name, in multiples of a unit; None of no values."""
    array = np.asarray(values)
    if not array.size:
        return None
    found = (np.percentile(array, list(shares.values())) / unit).tolist()
    return dict(zip(shares, found, strict=True))


def count_executed_ticks(log: Log, site: str) -> int | None:
    """Returns the number of ticks that a site made, by the event of its last start; None
    without one.
    """
    made = [event.ticks for event in log.events if (event.kind, event.member) == ("end", site)]
    return made[-1] if made else None


def count_overruns(part: SiteLog) -> int:
    """Returns how many ticks began later than a whole period."""
    return int(np.count_nonzero(part.late_us >= 1e6 / part.rate_hz))


def _number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else None


def summarise_run(log: Log, twin: Log | None = None) -> JsonObject:
    """Returns the numbers of a log, torn, short and empty ones too; `twin` is the run without
    operators.
    """
    sites = {name: _describe_site(log, name, twin) for name in log.sites}
    settled = [site["settle_s"] for site in sites.values()]
    largest = [
        site["max_error_end_rad"]
        for site in sites.values()
        if site["max_error_end_rad"] is not None
    ]
    scenario = log.scenario
    keys = ("name", "title", "sha256", "duration_s", "seed", "scheme")
    delays_ms = {
        name: finite_or_none(link.moments().mean_ms) for name, link in scenario.links.items()
    }
    return {
        "scenario": {
            **{key: getattr(scenario, key) for key in keys},
            "sites": list(scenario.names),
            "delay_ms": delays_ms,
            "dominance": scenario.dominance,
            "assumed": list(scenario.assumed),
            "arms": list_arm_notes(scenario),
        },
        "session": {
            **log.session,
            "complete": log.complete,
            "unknown_ends": list(log.unknown_ends),
        },
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
            | {"site": one.site, "taken_at_tick": one.taken_at_tick, "sentence": one.sentence}
            for one in list_changes(log)
        ],
    }


def _describe_site(log: Log, name: str, twin: Log | None) -> JsonObject:
    part = log[name]
    spec = log.scenario.sites[name]
    end = part.t_s > part.t_s[-1] - END_WINDOW_S if len(part) else np.zeros(0, dtype=bool)
    moved = operator_displacement(log, twin, name)[2] if twin is not None else part.q[:0]
    made = count_executed_ticks(log, name)
    expected = log.scenario.ticks(name)
    late = {"p50": 50.0, "p99": 99.0, "p99_9": 99.9, "max": 100.0}
    busy = PERCENTILES
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
        "late_us": compute_percentiles(part.late_us, late) or dict.fromkeys(late),
        "busy_us": compute_percentiles(part.busy_us, busy) or dict.fromkeys(busy),
        "overruns": count_overruns(part),
        "hands_moved_max_rad": np.abs(moved).max(axis=0).tolist() if len(moved) else None,
        "hands_moved_end_rad": moved[-1].tolist() if len(moved) else None,
    }


def _describe_link(log: Log, use: LinkSummary) -> JsonObject:
    counts = use.counts
    clock = summarise_clock(log, use.peer, use.site)
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
        "age_ms": use.age_ms._asdict()
        if use.age_ms
        else dict.fromkeys(ValueStatistics._fields),
        "ages": use.ages._asdict() if use.ages else None,
        **{
            key: getattr(use, key) for key in ("first_use_s", "ticks_without_new", "silence_ms")
        },
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
