"""Check of a log: bytes of its files, completeness of its session, agreement with scenario and
accounts.

Invariant: one finding per check, with the places where it fails; missing messages are named
range by range. Any MCAP file is checked for its bytes, only a trilat-net log for its content: a
message against its own content, its scenario and the messages before it. Nothing is executed:
that is the task of `verify`.
"""

import hashlib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..core.ticks import NS_PER_S
from ..errors import LogError, ScenarioError, WireError, count_nouns
from ..files import open_regular
from ..net import messages, topics
from ..net.wire import decode
from ..scenario import Scenario, parse_embedded
from ..scenario.run_changes import count_skipped_ticks
from .accounting import Account, SessionAccounts, describe_unknown_ends, parse_counts
from .findings import CheckReport, Finding, Findings
from .log_layout import (
    ACCOUNTS,
    CHANNEL_TYPES,
    MAX_TIME_NS,
    PART,
    SCENARIO,
    SESSION,
    VIZ_ROOT,
    parse_filter_facts,
)
from .log_reader import Log
from .mcap_check import FileCheck
from .mcap_reader import ChannelInfo, McapMessage, McapReader, Progress, shift_progress
from .message_identity import AnyMessage, identify_message
from .ros2 import cdr
from .running_digest import DigestState, Integrity

MAX_AHEAD_NS = 10 * NS_PER_S
"""No message is sent more than this after it came, whatever the clocks."""
MAX_BOOTS = 64
"""Starts of a member that are distinguished."""
_CDR_HEAD = b"\x00\x01"
_RATE_TOLERANCE = 0.02
_RATE_SPAN_NS = 2 * NS_PER_S
"""A rate is computed over no shorter a time."""
_ACCOUNTS_SINCE = 3
"""First version whose logs have an account of every channel."""


@dataclass(frozen=True, repr=False)
class LogCheckResult(CheckReport):
    """Result of a check of files.

    Attributes:
        files: their names.
        findings: one per check.
        ours: True if they are a trilat-net log; else only their bytes were checked.
    """

    files: list[str]
    findings: list[Finding]
    ours: bool

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat log check --json`."""
        kind = "trilat" if self.ours else "mcap"
        return {
            "files": self.files,
            "kind": kind,
            "sound": self.passed,
            "checks": self.to_rows(),
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per check."""
        keys = "check", "passed", "text", "places", "wrong"
        rows = [{key: getattr(one, key) for key in keys} for one in self.findings]
        return [{**row, "places": [at._asdict() for at in row["places"]]} for row in rows]


def check_file(*files: str | Path, progress: Progress | None = None) -> LogCheckResult:
    """Checks that a log is well-formed, complete and consistent; the command is `trilat log
    check`.

    Every byte of its file is checked, or of its parts.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("sound.mcap")
    >>> tn.check_file(path).passed
    True

    Raises:
        LogError: a file cannot be read, or is of another session than the files before it.
    """
    check = SessionCheck()
    paths = [Path(file) for file in files]
    try:
        total = sum(path.stat().st_size for path in paths)
        before = 0
        for path in sorted(paths, key=lambda path: path.name):
            with open_regular(path) as stream:
                check.read(str(path), stream, shift_progress(progress, before, total))
            before += path.stat().st_size
    except OSError as error:
        name = error.filename or " ".join(map(str, paths))
        raise LogError(f"{name}: cannot be read: {error.strerror}") from None
    return LogCheckResult(
        [path.as_posix() for path in paths], list(check.findings()), check.ours
    )


class ChannelCheck:
    """Check of one channel, message by message: numbering, schema and time stamps.

    Args:
        key: its member, and its kind: "state", "link", "event" or "stats".
        about: metadata of the session.
        scenario: its scenario; None if it cannot be read.
        findings: receives the problems.
        accounts: those of the session, which count its messages.

    Attributes:
        rate_hz: tick rate of the member; 0 of the recorder.
        received: number of messages, each number once.
        boots: the member's starts. first, last: number and publish time of the messages with
        the lowest and the highest number.
    """

    def __init__(
        self,
        key: topics.KeyParts,
        about: Mapping[str, str],
        scenario: Scenario | None,
        findings: Findings,
        accounts: SessionAccounts,
    ) -> None:
        self.member = key.member
        self.kind = key.channel
        self._topic = "/" + topics.key(key.session, key.member, key.channel)
        self.rate_hz = 0
        self._layout = None
        if scenario is not None and key.member in scenario.sites:
            self.rate_hz = scenario.sites[key.member].rate_hz
            self._layout = scenario.layout(key.member)
        self.received = 0
        self.boots = set[int]()
        self.first: tuple[int, int] | None = None
        self.last: tuple[int, int] | None = None
        self._findings = findings
        self._accounts = accounts
        self._epoch_ns = _parse_number(about, "epoch_unix_ns")
        self._version = _parse_number(about, "schema_version")
        self._in_file: dict[int, Account] = {}  # by boot
        self._file = ""
        self._log_ns = 0

    @property
    def name(self) -> str:
        """Its short name, as in "m1/state"."""
        return f"{self.member}/{self.kind}"

    def begin(self, file: str, channel: ChannelInfo) -> None:
        """Begins with another file, and checks how it describes the channel."""
        self._in_file = defaultdict(Account)
        self._file = file
        self._log_ns = 0
        if fault := self._find_schema_fault(channel):
            self._add("schema", None, fault)

    def _find_schema_fault(self, channel: ChannelInfo) -> str:
        kind = CHANNEL_TYPES[self.kind]
        rate = channel.metadata.get("rate_hz", str(self.rate_hz))
        if not channel.schema:
            return "has no schema"
        if (channel.encoding, channel.schema_encoding) != ("msgpack", "jsonschema"):
            return f"is {channel.encoding} with {channel.schema_encoding}, not msgpack with jsonschema"
        if channel.schema != (name := f"trilat.{kind.__name__}.v{self._version}"):
            return f"has the schema {channel.schema}, not {name}"
        if (
            self._version == messages.VERSION
            and channel.schema_data != json.dumps(messages.json_schema(kind)).encode()
        ):
            return f"the schema {channel.schema} is not what it was released as"
        if self.kind == topics.STATE and rate != str(self.rate_hz):
            return f"says {rate} Hz, the scenario {self.rate_hz}"
        return ""

    def take(self, stored: McapMessage, offset: int) -> None:
        """Checks a message; `offset` is its place, or that of its chunk."""
        kind: Any = CHANNEL_TYPES[self.kind]
        try:
            message = decode(stored.payload, kind, messages.READABLE, self._layout)
        except WireError as error:
            self._add("schema", offset, str(error))
            return
        identity = identify_message(message, self.rate_hz)
        number = identity.number
        sequence = identity.sequence
        if self.kind == topics.STATS:  # these state no number: the file counts them
            number = sequence = self._in_file[message.boot].expected
        if message.v != self._version:
            text = f"a message of version {message.v} in a log of version {self._version}"
            self._add("schema", offset, text)
        if identity.sender != self.member:
            self._add(
                "schema", offset, f"a message says that it is of {identity.sender[:40]!r}"
            )
        if number >= 0:  # events have numbers from version 3 on
            if stored.sequence != sequence & 0xFFFFFFFF:
                self._add(
                    "sequence", offset, f"number {sequence} is stored as {stored.sequence}"
                )
            self._count(message, number, stored.publish_time_ns, offset)
        elif isinstance(message, messages.Event):
            self._accounts.apply_event(message)
        self._check_times(stored, number, identity.sent_ns, offset)

    def _add(self, check: str, offset: int | None, text: str) -> None:
        self._findings[check].add(self._file, offset, f"{self.name}: {text}")

    def _count(self, message: AnyMessage, number: int, publish_ns: int, offset: int) -> None:
        if message.boot not in self.boots and len(self.boots) >= MAX_BOOTS:
            self._add("sequence", offset, f"more than {MAX_BOOTS} starts")
            return
        self.boots.add(message.boot)
        # parts may repeat a message, a file may not
        if not self._in_file[message.boot].receive(number):
            self._add("sequence", offset, f"number {number} is there twice")
        if isinstance(message, messages.Event):
            self.received += self._accounts.receive_event(self._topic, number, message)
        else:
            self.received += self.kind == topics.STATS or self._accounts.count_message(
                self._topic, number
            )
        if self.rate_hz and isinstance(message, messages.State) and message.cmd:
            self._accounts.mark_skipped_ticks(
                self.member, message.tick, count_skipped_ticks(message.cmd)
            )
        place = (number, publish_ns)
        self.first = place if self.first is None else min(self.first, place)
        self.last = place if self.last is None else max(self.last, place)

    def _check_times(
        self, stored: McapMessage, number: int, stated_ns: int | None, offset: int
    ) -> None:
        log_ns = stored.log_time_ns
        publish_ns = stored.publish_time_ns
        if log_ns < self._log_ns:
            text = f"log_time goes back by {self._log_ns - log_ns} ns at number {number}"
            self._add("times", offset, text)
        self._log_ns = log_ns
        sent_ns = publish_ns
        if stated_ns is not None:
            sent_ns = min(max(0, self._epoch_ns + stated_ns), MAX_TIME_NS)
        if publish_ns != sent_ns:
            self._add(
                "times", offset, f"number {number} was sent at {sent_ns} ns, not {publish_ns}"
            )
        elif publish_ns > log_ns + MAX_AHEAD_NS:
            ahead_s = (publish_ns - log_ns) / NS_PER_S
            self._add(
                "times", offset, f"number {number} came {ahead_s:.1f} s before it was sent"
            )


def _parse_number(about: Mapping[str, str], key: str) -> int:
    text = about.get(key, "")
    return int(text) if re.fullmatch(r"\d{1,19}", text) else 0


class SessionCheck:
    """Check of one session, in one file or in its parts.

    Attributes:
        ours: True if there is a trilat-net log at all.
        channels: the checks of its channels, by topic.
    """

    def __init__(self) -> None:
        self.ours = False
        self.channels: dict[str, ChannelCheck] = {}
        self._findings = Findings()
        self._counts: Counter[str] = Counter()
        self._scenario: Scenario | None = None
        self._about: dict[str, str] = {}
        self._counted = SessionAccounts("", None)
        self._accounts: dict[str, str] = {}  # of the last file
        self._first_part = False  # the files begin with the session
        self._files = self._parts = 0  # files of the session, and those that are parts of a log
        self._views = self._version = 0
        self._file = self._chain_text = ""

    def read(self, file: str, stream: BinaryIO, progress: Progress | None = None) -> None:
        """Checks every byte of a file, and its messages.

        Raises:
            LogError: it is of another session than the files before it.
        """
        reader = McapReader(stream, file, progress, kept=False)
        structure = FileCheck(file, reader.scanner, self._findings)
        reader.watch = structure.check_record
        if reader.scanner.begins:
            self._read_messages(file, reader)
        structure.finish()
        self._counts += structure.counts

    def _read_messages(self, file: str, reader: McapReader) -> None:
        checks: dict[str, ChannelCheck | None] = {}
        self._file = file
        begun = False
        for message in reader.messages():
            if not begun:
                begun = True
                self._begin(reader)
            topic = message.topic
            if not self.ours or not topic:
                continue
            try:
                check = checks[topic]
            except KeyError:
                check = checks[topic] = self._begin_channel(reader.channels[topic])
            if check is not None:
                check.take(message, reader.offset)
            elif topic.startswith(VIZ_ROOT):
                self._views += 1
                if message.payload[:2] != _CDR_HEAD:
                    self._findings["schema"].add(
                        file, reader.offset, f"{topic[:80]}: a message is no CDR"
                    )
        if not begun:
            self._begin(reader)
        self._accounts = reader.metadata.get(ACCOUNTS, {})
        chain = reader.judge_digest()
        self._chain_text = chain.text
        if not chain.passed:
            self._findings["chain"].add(file, None, self._chain_text)

    def _begin(self, reader: McapReader) -> None:
        about = reader.metadata.get(SESSION, {})
        if not {"session", "driver"} <= about.keys() or SCENARIO not in reader.attachments:
            if self.ours:
                raise LogError(f"{self._file}: is no part of that log; look at it alone")
            return
        same = ("session", "epoch_unix_ns", "scenario_sha256")
        if self.ours and any(about.get(key) != self._about.get(key) for key in same):
            raise LogError(f"{self._file}: is of another session; look at it alone")
        is_new = not self.ours
        self.ours = True
        self._about = about
        self._version = _parse_number(about, "schema_version")
        self._files += 1
        self._parts += PART in reader.metadata
        self._first_part |= reader.metadata.get(PART, {}).get("index", "") in ("", "1")
        self._check_scenario(reader.attachments[SCENARIO])
        if is_new:
            continued = not self._first_part
            self._counted = SessionAccounts(
                about["session"], self._scenario, continued=continued
            )
            # events may tell of them first
            for name in self._scenario.names if self._scenario else ():
                for channel in (topics.STATE, topics.LINK):
                    self._counted.open_channel(
                        "/" + topics.key(about["session"], name, channel)
                    )

    def _check_scenario(self, text: bytes) -> None:
        finding = self._findings["scenario"]
        about = self._about
        digest = hashlib.sha256(text).hexdigest()
        stated = about.get("scenario_sha256", "")
        if digest != stated:
            finding.add(
                self._file,
                None,
                f"its SHA-256 is {digest[:16]}, the session names {stated[:16]}",
            )
        try:
            self._scenario = scenario = parse_embedded(text.decode(), "scenario")
        except (ScenarioError, UnicodeDecodeError) as error:
            finding.add(self._file, None, f"cannot be read: {error}")
            return
        facts = {
            "scenario": scenario.name,
            "seed": str(scenario.seed),
            "sites": " ".join(scenario.names),
        }
        for key, value in facts.items():
            if about.get(key) != value:
                there = about.get(key, "")[:40]
                finding.add(self._file, None, f"has {key} {value}, the session {there!r}")

    def _begin_channel(self, channel: ChannelInfo) -> ChannelCheck | None:
        """Returns the check of a channel in this file; None if it is none of the session's own."""
        topic = channel.topic
        finding = self._findings["schema"]
        key = topics.parse_key(topic.removeprefix("/"))
        if topic.startswith(VIZ_ROOT):
            is_cdr = (channel.encoding, channel.schema_encoding) == (
                cdr.ENCODING,
                cdr.SCHEMA_ENCODING,
            )
            if not is_cdr or channel.schema_data != cdr.ROS2_SCHEMAS.get(channel.schema):
                schema = channel.schema[:80] or "no schema"
                finding.add(
                    self._file, None, f"{topic[:80]}: {schema} is none of the standard ones"
                )
            return None
        session = self._about["session"]
        if (
            key is None
            or key.channel not in CHANNEL_TYPES
            or key.session != session
            or key.boot
        ):
            if not channel.schema:
                finding.add(self._file, None, f"{topic[:80]}: has no schema")
            return None
        if topic not in self.channels:
            if self._scenario and key.member not in (*self._scenario.sites, topics.RECORDER):
                finding.add(self._file, None, f"{topic[:80]}: the scenario has no such member")
            self._counted.open_channel(topic)
            of = self._about, self._scenario, self._findings, self._counted
            self.channels[topic] = ChannelCheck(key, *of)
        self.channels[topic].begin(self._file, channel)
        return self.channels[topic]

    def findings(self) -> Iterator[Finding]:
        """Yields the results, once all files were read; without a session only that it was
        taken out.
        """
        counts = self._counts
        found = self._findings
        messages = counts["messages"]
        chunks = counts["chunks"]
        yield found["whole"].conclude(f"finished, {counts['bytes'] / 1e6:.1f} MB")
        yield found["checksums"].conclude(f"{counts['crcs']} compared, all agree")
        yield found["records"].conclude(
            f"{count_nouns(messages, 'message')} in {count_nouns(chunks, 'chunk')}, built as the format says"
        )
        yield found["index"].conclude("is what is there")
        if not self.ours:
            if "chain" in found:
                yield found["chain"].conclude("")
            return
        yield self._check_sequence()
        yield self._check_accounts()
        yield found["chain"].conclude(self._chain_text)
        kinds = f"every message is one of version {self._version}"
        views = f", and {count_nouns(self._views, 'view')}" if self._views else ""
        yield found["schema"].conclude(kinds + views)
        yield found["times"].conclude("log times never go back, publish times are the senders'")
        yield self._check_rates()
        scenario = self._scenario.name if self._scenario else ""
        text = f"{scenario}, SHA-256 {self._about.get('scenario_sha256', '')[:16]}, as the session names it"
        yield found["scenario"].conclude(text)

    def _check_sequence(self) -> Finding:
        finding = self._findings["sequence"]
        missing = 0
        reordered = 0
        gaps = []
        for topic, check in self.channels.items():
            if check.kind == topics.STATS:
                continue
            for first, last in self._counted.list_gaps(topic):
                missing += last - first + 1
                gaps.append(
                    f"{check.name} {first}-{last}" if last > first else f"{check.name} {first}"
                )
            reordered += sum(account.reordered for account in self._counted.list_starts(topic))
        received = sum(check.received for check in self.channels.values())
        text = f"{count_nouns(received, 'message')} of {count_nouns(len(self.channels), 'channel')}"
        if missing:
            text += f", {missing} missing in {len(gaps)} range{'s' * (len(gaps) > 1)}"
        elif finding.passed:
            text += ", none missing, none twice"
        if not finding.passed:
            text += f"; {finding.summary()}"
        if reordered:
            text += f"; {reordered} came late"
        if self._takes_events and (silent := self._counted.unknown_ends):
            text += f"; {describe_unknown_ends(silent)}"
        for gap in gaps:
            finding.add("", None, f"missing {gap}")
        finding.text = text
        return finding

    @property
    def _takes_events(self) -> bool:
        """True if the files must tell how the sites ended: all of a log that leaves no events
        out.
        """
        session = self._about["session"]
        choice = parse_filter_facts(self._about)
        names = self._scenario.names if self._scenario else ()
        takes = all(choice.accepts(topics.key(session, name, topics.EVENT)) for name in names)
        is_single_part = self._files == self._parts == 1
        return takes and not is_single_part

    def _check_accounts(self) -> Finding:
        finding = self._findings["accounts"]
        if not self._accounts:
            return finding.conclude("there are none: the file was not finished")
        own = (check for check in self.channels.values() if check.member == topics.RECORDER)
        if not self._first_part or len({boot for check in own for boot in check.boots}) > 1:
            return finding.conclude("tell of parts that are not here, and were not compared")
        for topic, check in self.channels.items():
            stated = parse_counts(self._accounts.get(topic, ""))
            if check.kind != topics.STATS:
                missing = sum(account.missing for account in self._counted.list_starts(topic))
                there = {"received": check.received, "missing": missing}
                for word, count in stated.items():
                    if count != there[word]:
                        text = f"{check.name}: {count} {word} by the account, {there[word]} by the file"
                        finding.add("", None, text)
            if not stated and self._version >= _ACCOUNTS_SINCE:
                finding.add("", None, f"{check.name}: has no account")
        return finding.conclude("agree with what is there")

    def _check_rates(self) -> Finding:
        finding = self._findings["rates"]
        texts = []
        for check in self.channels.values():
            if (
                check.kind != topics.STATE
                or check.first is None
                or check.last is None
                or not check.rate_hz
            ):
                continue
            span_ns = check.last[1] - check.first[1]
            if span_ns < _RATE_SPAN_NS:
                continue
            rate_hz = (check.last[0] - check.first[0]) * NS_PER_S / span_ns
            texts.append(f"{check.member} {rate_hz:.1f} Hz")
            if abs(rate_hz / check.rate_hz - 1) > _RATE_TOLERANCE:
                sent = f"{check.member} sent {rate_hz:.1f} records a second"
                finding.add("", None, f"{sent}, the scenario says {check.rate_hz}")
        return finding.conclude(", ".join(texts) or "too short to tell")


def judge_integrity(log: Log) -> Integrity:
    """Returns whether a log is as it was made: by its digest chain, its accounts and its
    statistics.

    Raises:
        LogError: a message cannot be read.
    """
    if log.chain.passed:
        for site in log.sites:
            if seam := _find_unexplained(log, site):
                return Integrity(DigestState.CHANGED, seam)
    return log.chain


def _find_unexplained(log: Log, site: str) -> str:
    """Describes a gap of a site that is none of the run's own; "" if there is none.

    One of which neither the accounts nor the recorder's statistics tell is the seam of a
    splice, or a stretch that was cut out.
    """
    if log.damaged:
        return ""
    ticks = np.unique(log[site].tick)
    # of several it is counted anew
    stated = parse_counts(log.account(site)) if len(log.sources) == 1 else {}
    there = {"received": len(ticks), "missing": log.missing(site)}
    if not log.part and stated not in ({}, there):
        told = " and ".join(f"{stated.get(word, 0)} {word}" for word in there)
        found = " and ".join(f"{n} {word}" for word, n in there.items())
        return f"records of {site} were taken out or put in: its account says {told}, the file has {found}"
    inner = int(ticks[-1] - ticks[0]) + 1 - len(ticks) if len(ticks) else 0
    inner -= min(inner, log.absent_ticks(site))
    if not inner or log.chain.state is DigestState.INTACT:
        return ""
    counts = [stats.missing.get(f"{site}/state", 0) for stats in log.recorder_stats()]
    if inner <= max([stated.get("missing", 0), *counts]):
        return ""
    lost = count_nouns(inner, f"record of {site} is", f"records of {site} are")
    return f"{lost} missing in between, and nothing in the log explains it"
