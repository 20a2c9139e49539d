"""Describes the content of recorded files, and summarises recorded runs.

`info` describes any MCAP file: its layout, its channels, missing messages, and message rates.
For a log of this program it also reports how well the control loops, the network links and the
clocks worked. `summarise_run` computes the content of the file `summary.json` of a run.

Invariant:
    - The channels and messages are listed without decoding any message, which works for any
      MCAP file. If a log cannot be opened, the overview states the reason.
    - Missing messages are counted only in channels whose messages have consecutive sequence
      numbers.
    - Keys end in their unit. A quantity that the log does not determine is `None`, never NaN.
    - A run is never executed again for its summary.
"""

from array import array
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import LogError, count_nouns
from ..log import SESSION, Log, McapReader, Progress, SiteLog, open_log
from ..records import NS_PER_S
from ..results import JsonObject, Result, finite_or_none
from ..scenario import END_WINDOW_S
from .link_summary import ONE_WAY_SCHEMA_VERSION, ClockSummary, LinkSummary, ValueStatistics
from .site_signals import (
    SETTLED_ERROR_RAD,
    operator_displacement,
    settling_time_of_all_s,
    settling_time_s,
)
from .timeline import Timeline

MOST_LISTED_GAPS = 1000
"""Largest number of gaps that are listed per channel."""


class _Messages(NamedTuple):
    """Times, numbers and sizes of all messages of one channel of an MCAP file.

    Each array has one entry per message, in the order of the file. The contents of the messages
    are not kept, because a log may be larger than the memory.

    Attributes:
        log_ns: Times at which the recorder received the messages, in ns.
        sequence: Sequence numbers, which are the ticks in the channels of sites.
        size: Sizes of the payloads, in bytes.
    """

    log_ns: "array[int]"
    sequence: "array[int]"
    size: "array[int]"


class _FileInventory:
    """Contents of one or several MCAP files: channels, message counts, times and damage.

    MCAP is the file format of the logs. Several files are treated as the parts of one log.

    Args:
        paths: The files.
        progress: Function that is called with the number of bytes read so far and the total
            number of bytes.

    Attributes:
        files: Size, compression, damage and other facts of every file, with keys that end in
            their unit.
        metadata: Metadata records of all files, keyed by name. A later file overrides an
            earlier one.

    Raises:
        LogError: A file cannot be read, or is not an MCAP file.
    """

    def __init__(self, paths: Sequence[Path], progress: Progress | None = None) -> None:
        self.files: list[JsonObject] = []
        self.metadata: dict[str, dict[str, str]] = {}
        # Encoding of the messages and name of their schema, by topic.
        self._formats: dict[str, tuple[str, str]] = {}
        self._messages: defaultdict[str, _Messages] = defaultdict(
            lambda: _Messages(array("Q"), array("Q"), array("Q"))
        )

        McapReader.read_files(paths, self._read_file, progress)

    def _read_file(self, path: Path, reader: McapReader) -> None:
        """Adds a file to the inventory: its channels, the numbers of its messages, its damage.

        Args:
            path: The file.
            reader: Reader of the file, from which no message has been read yet.
        """
        for topic, payload, log_ns, _, sequence in reader.messages():
            messages = self._messages[topic]
            messages.log_ns.append(log_ns)
            messages.sequence.append(sequence)
            messages.size.append(len(payload))

        formats = {
            topic: (channel.encoding, channel.schema)
            for topic, channel in reader.channels.items()
        }
        self._formats = {**formats, **self._formats}
        self.metadata.update(reader.metadata)
        self.files.append(
            {
                "path": path.as_posix(),
                "size_bytes": reader.size,
                "library": reader.library,
                "finished": reader.complete,
                "cut_off_at_byte": None if reader.torn is None else reader.torn.offset,
                "damaged": [part._asdict() for part in reader.damaged],
                "chunks": reader.chunks.total(),
                "compression": {name or "none": count for name, count in reader.chunks.items()},
                "packed_bytes": reader.packed_bytes,
                "unpacked_bytes": reader.unpacked_bytes,
                "attachments": {name: len(data) for name, data in reader.attachments.items()},
                "metadata": sorted(reader.metadata),
                "part": reader.metadata.get("trilat.part", {}),
            }
        )

    def channels(self, log: Log | None) -> dict[str, JsonObject]:
        """Describes the messages in each channel (topic) of the files, for `trilat log info`.

        Args:
            log: The log that the files contain, or `None` if they are not a log. Missing
                messages are counted only in a log.

        Returns:
            A mapping from topic to plain values.
        """
        topics_in_order = dict.fromkeys([*self._formats, *self._messages])
        channels = {}
        for topic in topics_in_order:
            gaps = _describe_gaps(log, topic, self._messages[topic].sequence)
            channels[topic] = self._describe_channel(topic) | gaps
        return channels

    def _describe_channel(self, topic: str) -> JsonObject:
        """Returns the number, sizes, times and encoding of the messages of one channel.

        Args:
            topic: Topic of the channel.
        """
        encoding, schema = self._formats.get(topic, ("", ""))

        messages = self._messages[topic]
        log_ns = np.frombuffer(messages.log_ns, dtype=np.uint64)
        sizes = np.frombuffer(messages.size, dtype=np.uint64)
        first_ns = int(log_ns.min()) if len(log_ns) else None
        last_ns = int(log_ns.max()) if len(log_ns) else None
        span_s = 0.0
        if first_ns is not None and last_ns is not None:
            span_s = (last_ns - first_ns) / NS_PER_S

        # a time beyond the range of int64 would turn negative
        signed_ns = np.minimum(log_ns, (1 << 63) - 1).astype(np.int64)
        return {
            "messages": len(log_ns),
            "bytes": int(sizes.sum()),
            "rate_hz": (len(log_ns) - 1) / span_s if span_s else None,
            "first_log_time_ns": first_ns,
            "last_log_time_ns": last_ns,
            "between_ms": _compute_percentiles(np.diff(signed_ns), unit=1e6),
            "encoding": encoding,
            "schema": schema,
        }


def _describe_gaps(log: Log | None, topic: str, sequence: Sequence[int]) -> JsonObject:
    """Returns the numbers of missing and of duplicate messages of a channel.

    Args:
        log: The log to which the channel belongs. `None` if the files are not a log.
        topic: Topic of the channel.
        sequence: Tick of every message, in the order of the file.

    Returns:
        The number of missing messages, the gaps as spans of message numbers, and the number of
        duplicates. All are `None` for channels without consecutive numbers.
    """
    account = log.count_messages(topic, sequence) if log is not None else None
    if account is None:
        return {"missing": None, "gaps": None, "duplicates": None}
    return {
        "missing": account.missing,
        "gaps": account.gaps[:MOST_LISTED_GAPS],
        "duplicates": account.duplicate,
    }


@dataclass(frozen=True, repr=False)
class FileOverview(Result):
    """Overview of one or several recorded MCAP files, returned by `info`.

    A log that was recorded in several files is described as one.

    Attributes:
        facts: The overview as plain values. The keys are those of `trilat log info --json`.
    """

    facts: JsonObject

    def headline(self) -> str:
        """One line for the user with the paths of all files and the number of messages.

        An example is "run.mcap: 120345 messages".
        """
        channels = self.facts["channels"].values()
        messages = sum(channel["messages"] for channel in channels)
        message_count = count_nouns(messages, "message")
        paths = ", ".join(file["path"] for file in self.facts["files"])
        return f"{paths}: {message_count}"

    def to_dict(self) -> JsonObject:
        """Returns a summary of the files, with the keys of `trilat log info --json`.

        For example, the entry "channels" maps each topic to facts such as its number of
        messages.
        """
        return self.facts

    def to_rows(self) -> list[JsonObject]:
        """Returns the channels of the file as a table, with one row per channel.

        Each row contains the topic and all facts about the channel, such as its number of
        messages.
        """
        return [
            {"topic": topic, **channel} for topic, channel in self.facts["channels"].items()
        ]


def info(*files: str | Path, progress: Progress | None = None) -> FileOverview:
    """Returns an overview of an MCAP file, or of the parts of one log.

    `trilat log info` shows the same overview. The key `kind` is "trilat" for a log of this
    program that could be opened, and "mcap" otherwise. If the file looks like a log of this
    program but cannot be opened, `problem` states why.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("short.mcap")
    >>> tn.info(path).to_dict()["sites"]["m"]["records"]
    100

    Args:
        files: The file, or the parts of one log.
        progress: Function that is called with the amount of work done so far and the total
            amount.

    Raises:
        LogError: A file cannot be read, or is not an MCAP file.
    """
    paths = [Path(file) for file in files]

    def report_pass(number: int) -> Progress | None:
        """Returns a function that reports the progress of one of two passes over the files.

        `info` reads the files twice. The two passes are combined into one progress value from 0
        to 1.

        Args:
            number: 0 for the first pass, which covers the first half of the progress, 1 for the
                second.

        Returns:
            The function, or `None` if the caller of `info` does not want progress reports.
        """
        if progress is None:
            return None
        return lambda done, total: progress(number * total + done, 2 * total)

    inventory = _FileInventory(paths, report_pass(0))
    facts: JsonObject = {
        "files": inventory.files,
        "kind": "mcap",
        "problem": None,
        "session": None,
        "sites": {},
        "links": {},
    }
    readable_log = None
    if SESSION in inventory.metadata:
        try:
            log = open_log(*paths, progress=report_pass(1))
            facts |= _describe_log(log)
            readable_log = log
        except LogError as error:
            facts["problem"] = str(error)
    facts["channels"] = inventory.channels(readable_log)
    return FileOverview(facts)


def _describe_log(log: Log) -> JsonObject:
    """Returns the contents of a log as plain values: its session, its arms and network links.

    Args:
        log: The log.
    """
    links = {}
    for site in log.sites:
        for peer in log[site].peers:
            links[f"{peer}->{site}"] = _describe_link_health(log, peer, site)
    return {
        "kind": "trilat",
        "session": _describe_session(log),
        "sites": {site: describe_site_health(log, site) for site in log.sites},
        "links": links,
    }


_PROVENANCE = ("commit", "commit_dirty", "fingerprint", "platform", "python", "schema_version")
_LAST_EPOCH_NS = 253_402_300_799 * NS_PER_S
"""The last second of the year 9999 in Unix time, the latest time that `datetime` represents."""


def _describe_session(log: Log) -> JsonObject:
    """Collects the facts about the session of a log that `trilat log info` shows.

    The facts are the start time, the length, the end of each site, the scenario, and the
    versions of the programs that wrote the log.

    Args:
        log: The log.

    Returns:
        The facts as plain values, ready for JSON.
    """
    session = log.session
    scenario = log.scenario
    epoch_ns = _parse_number(session.get("epoch_unix_ns", ""))
    last_ticks_s = [
        int(log[site].tick[-1]) / log[site].rate_hz for site in log.sites if len(log[site])
    ]
    began_utc = None
    if log.driver == "live" and epoch_ns is not None:
        began = datetime.fromtimestamp(min(epoch_ns, _LAST_EPOCH_NS) // NS_PER_S, UTC)
        began_utc = began.strftime("%Y-%m-%d %H:%M:%S")

    version_prefix = "version_"
    versions = {
        key.removeprefix(version_prefix): value
        for key, value in session.items()
        if key.startswith(version_prefix)
    }

    return {
        "session": session["session"],
        "driver": log.driver,
        "complete": log.complete,
        "began_utc": began_utc,
        "epoch_unix_ns": epoch_ns,
        "recorded_s": max(last_ticks_s, default=0.0),
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
            "arms": scenario.list_arm_notes(),
        },
        **{key: session.get(key) for key in _PROVENANCE},
        "versions": versions,
        "accounts": log.accounts,
    }


def describe_site_health(log: Log, site: str) -> JsonObject:
    """Describes how complete a site's records are, and how punctually its ticks began.

    The timing is `None` for a simulated run, in which no clock is read.

    Args:
        log: The log of the run.
        site: Name of the site.

    Returns:
        Plain values, ready for JSON.
    """
    site_log = log[site]
    spec = log.scenario.sites[site]
    is_timed = log.driver == "live"
    return {
        "role": spec.role,
        "rate_hz": spec.rate_hz,
        "records": len(site_log),
        "made_ticks": _count_executed_ticks(log, site),
        "expected_ticks": log.scenario.ticks(site),
        "missing": log.missing(site),
        "late_us": _compute_percentiles(site_log.late_us) if is_timed else None,
        "busy_us": _compute_percentiles(site_log.busy_us) if is_timed else None,
        "overruns": _count_overruns(site_log) if is_timed else None,
        "skipped": site_log.skipped,
    }


def _describe_link_health(log: Log, peer: str, site: str) -> JsonObject:
    """Collects facts on how well the link from a peer to a site worked.

    The facts are the delay that the scenario prescribes, the age of the samples in use, the
    measured one-way delay, the offset of the clocks, and the last counts that the site
    published. A fact that the log does not contain is `None`.

    Args:
        log: The log of the run.
        peer: Name of the sender.
        site: Name of the receiver.

    Returns:
        The facts as plain values, ready for JSON.
    """
    clock_summary = ClockSummary.of_link(log, peer, site)
    one_way_us = np.zeros(0, dtype=np.int64)  # not measured in virtual time
    version = _parse_number(log.session.get("schema_version", "")) or 0
    if log.driver == "live" and version >= ONE_WAY_SCHEMA_VERSION:
        arrivals = log[site].arrivals[1]
        is_from_peer = arrivals[:, 0] == log[site].peers.index(peer)
        one_way_us = arrivals[is_from_peer, 2]

    # the last report of the site contains the counts since its start
    counts: JsonObject = dict.fromkeys(
        ("accepted", "lost", "late", "superseded", "duplicate", "refused")
    )
    for last_stats in log.link_stats(site)[-1:]:
        counts = {name: getattr(last_stats, name).get(peer) for name in counts}
    return {
        "stated": log.scenario.links[f"{peer}->{site}"].describe(),
        "age_ms": _compute_percentiles(log.sample_ages_ns(peer, site), unit=1e6),
        "one_way_ms": _compute_percentiles(one_way_us, unit=1e3),
        "clock_offset_us": None if clock_summary is None else clock_summary.offset_us,
        "clock_bound_us": None if clock_summary is None else clock_summary.bound_us,
        **counts,
    }


PERCENTILES = {"p50": 50.0, "p99": 99.0, "max": 100.0}
_LATENESS_PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99_9": 99.9, "max": 100.0}


def _compute_percentiles(
    values: ArrayLike,
    shares: Mapping[str, float] = PERCENTILES,
    unit: float = 1.0,
) -> dict[str, float] | None:
    """Computes percentiles, such as the median, of a list of numbers.

    Args:
        values: The numbers.
        shares: Percentage of each percentile, by the name of the percentile in the result.
        unit: Number by which the values are divided, to change their unit.

    Returns:
        The percentiles, by name. `None` if there are no numbers.
    """
    numbers = np.asarray(values)
    if not numbers.size:
        return None
    percentages = list(shares.values())
    percentiles = np.percentile(numbers, percentages) / unit
    return dict(zip(shares, percentiles.tolist(), strict=True))


def _count_executed_ticks(log: Log, site: str) -> int | None:
    """Returns the number of control periods (ticks) that the process of an arm executed.

    The process itself reports the number in its event "end" at the end of a run.

    Args:
        log: The log of the run.
        site: Name of the site.

    Returns:
        The number in the last event "end". `None` if the site published no such event.
    """
    ticks = None
    for event in log.events:
        if event.kind == "end" and event.member == site:
            ticks = event.ticks
    return ticks


def _count_overruns(site_log: SiteLog) -> int:
    """Counts the ticks of a site that started more than a whole tick period late."""
    period_us = 1e6 / site_log.rate_hz
    is_overrun = site_log.late_us >= period_us
    return int(np.count_nonzero(is_overrun))


def _parse_number(text: str) -> int | None:
    """Parses a number of at most 19 decimal digits. Returns `None` for any other text."""
    is_number = text.isascii() and text.isdigit()
    if is_number and len(text) < 20:
        return int(text)
    return None


def summarise_run(log: Log, twin: Log | None = None) -> JsonObject:
    """Collects the most important quantities of a run, for the file `summary.json`.

    The log may be truncated, short or empty. Quantities that the log does not determine are
    `None`.

    Args:
        log: The log of the run.
        twin: Log of the same run without operators, used to compute the effect of the
            operators, or `None` if there is no such log.

    Returns:
        Plain values, ready for JSON.
    """
    sites = {site: _summarise_site(log, site, twin) for site in log.sites}
    settling_times_s = [site["settle_s"] for site in sites.values()]
    end_errors_rad = [site["max_error_end_rad"] for site in sites.values()]
    known_end_errors_rad = [error_rad for error_rad in end_errors_rad if error_rad is not None]

    scenario = log.scenario
    scenario_keys = ("name", "title", "sha256", "duration_s", "seed", "scheme")

    changes = [
        {
            "at_s": entry.change.at_s,
            "about": entry.subject,
            "to": entry.text,
            "site": entry.site,
            "taken_at_tick": entry.taken_at_tick,
            "sentence": entry.sentence,
        }
        for entry in Timeline(log).changes
    ]

    return {
        "scenario": {
            **{key: getattr(scenario, key) for key in scenario_keys},
            "sites": list(scenario.names),
            "delay_ms": {
                name: finite_or_none(link.moments().mean_ms)
                for name, link in scenario.links.items()
            },
            "dominance": scenario.dominance,
            "assumed": list(scenario.assumed),
            "arms": scenario.list_arm_notes(),
        },
        "session": {
            **log.session,
            "complete": log.complete,
            "unknown_ends": list(log.unknown_ends),
        },
        "diverged": any(site["diverged_at_s"] is not None for site in sites.values()),
        "settle_s": settling_time_of_all_s(settling_times_s),
        "settle_below_rad": SETTLED_ERROR_RAD,
        "max_error_end_rad": max(known_end_errors_rad, default=None),
        "records": sum(site["records"] for site in sites.values()),
        "missing": sum(site["missing"] for site in sites.values()),
        "sites": sites,
        "links": {
            link.name: _summarise_link(log, link) for link in LinkSummary.list_of_log(log)
        },
        "changes": changes,
    }


def _summarise_site(log: Log, site: str, twin: Log | None) -> JsonObject:
    """Returns the most important quantities of one arm in a run, such as its largest error.

    These quantities are written to `summary.json`, from which other programs can read them.

    Args:
        log: The log of the run.
        site: Name of the site.
        twin: Log of the same run without operators, or `None`.
    """
    site_log = log[site]
    spec = log.scenario.sites[site]
    at_end = np.zeros(0, dtype=bool)
    if len(site_log):
        at_end = site_log.t_s > site_log.t_s[-1] - END_WINDOW_S
    displacement = site_log.q[:0]
    if twin is not None:
        displacement = operator_displacement(log, twin, site)[2]

    executed = _count_executed_ticks(log, site)
    expected = log.scenario.ticks(site)
    ticks = expected if executed is None else executed
    late_us = _compute_percentiles(site_log.late_us, _LATENESS_PERCENTILES)
    busy_us = _compute_percentiles(site_log.busy_us)
    tau_limit_nm = spec.limits.tau_limit_nm
    at_limit = np.abs(site_log.tau) >= tau_limit_nm

    moved_max_rad = None
    moved_end_rad = None
    if len(displacement):
        largest_displacement = np.abs(displacement).max(axis=0)
        moved_max_rad = largest_displacement.tolist()
        moved_end_rad = displacement[-1].tolist()

    return {
        "role": spec.role,
        "rate_hz": spec.rate_hz,
        "records": len(site_log),
        "expected_ticks": expected,
        "made_ticks": executed,
        "missing": max(0, ticks - log.absent_ticks(site) - len(site_log)),
        "diverged_at_s": site_log.diverged_s,
        "modes": [interval._asdict() for interval in Timeline(log).find_mode_intervals(site)],
        "q_end_rad": site_log.q[-1].tolist() if len(site_log) else None,
        "max_error_rad": _largest_magnitude(site_log.e),
        "max_error_end_rad": _largest_magnitude(site_log.e[at_end]),
        "settle_s": settling_time_s(site_log),
        "peak_tau_nm": _largest_magnitude(site_log.tau),
        "saturated_ticks": int(np.count_nonzero(at_limit.any(axis=1))),
        "late_us": late_us or dict.fromkeys(_LATENESS_PERCENTILES),
        "busy_us": busy_us or dict.fromkeys(PERCENTILES),
        "overruns": _count_overruns(site_log),
        "skipped": site_log.skipped,
        "hands_moved_max_rad": moved_max_rad,
        "hands_moved_end_rad": moved_end_rad,
    }


def _summarise_link(log: Log, link: LinkSummary) -> JsonObject:
    """Returns the quantities of a link for `summary.json`, such as its delays and losses."""
    counts = link.counts
    clock = ClockSummary.of_link(log, link.peer, link.site)

    stated = []
    for model in link.stated.models:
        moments = model.link.moments()
        stated.append(
            {
                "from_s": model.from_s,
                "link": model.link.describe(),
                "mean_ms": finite_or_none(moments.mean_ms),
                "deviation_ms": finite_or_none(moments.deviation_ms),
            }
        )

    age_ms: JsonObject = dict.fromkeys(ValueStatistics._fields)
    if link.age_ms:
        age_ms = link.age_ms._asdict()

    return {
        "delay_ms": finite_or_none(link.stated.models[0].link.moments().mean_ms),
        "stated": stated,
        "drawn_ms": link.drawn_ms._asdict() if link.drawn_ms else None,
        "age_ms": age_ms,
        "ages": link.ages._asdict() if link.ages else None,
        "first_use_s": link.first_use_s,
        "ticks_without_new": link.ticks_without_new,
        "silence_ms": link.silence_ms,
        "samples": counts._asdict() if counts else None,
        "late_samples": counts.late if counts else None,
        "duplicate_samples": counts.duplicate if counts else None,
        "loss": link.loss,
        "burst": link.burst,
        "one_way_us": link.one_way_us._asdict() if link.one_way_us else None,
        "clock": clock._asdict() if clock else None,
    }


def _largest_magnitude(values: ArrayLike) -> float | None:
    """Returns the largest absolute value. Returns `None` if there are no values."""
    magnitudes = np.abs(np.asarray(values))
    return float(magnitudes.max()) if magnitudes.size else None
