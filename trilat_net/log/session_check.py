"""Checks a log: its bytes, its completeness, and its consistency with its scenario.

Implements `trilat log check`. The bytes of any MCAP file are checked, but the content only if
the file is a log of trilat-net. Each message is then compared with its position in the file,
with the scenario, and with the earlier messages. The control laws are not executed again. That
is the task of `trilat_net.execution.verification`.

Invariant:
    - Each check produces one finding, which lists the places where the check failed.
    - Missing messages are listed as ranges of their numbers.
"""

import hashlib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from ..errors import LogError, ScenarioError, WireError, count_nouns
from ..files import open_regular
from ..net import decode, messages, topics
from ..records import NS_PER_S
from ..scenario import Scenario, parse_embedded
from .accounting import Account, count_skipped_ticks, describe_unknown_ends
from .findings import CheckReport, Finding, Findings
from .log_layout import (
    ACCOUNTS,
    CHANNEL_TYPES,
    MAX_TIME_NS,
    PART,
    SCENARIO,
    SESSION,
    VIZ_ROOT,
    ChannelFilter,
    describe_unfinished,
)
from .mcap_check import FileCheck
from .mcap_reader import ChannelInfo, McapMessage, McapReader, Progress, shift_progress
from .mcap_records import ScannedRecord
from .message_identity import AnyMessage, MessageIdentity
from .ros2 import cdr
from .session_accounts import SessionAccounts

_MAX_AHEAD_NS = 10 * NS_PER_S
"""Maximum time by which sending may appear to be later than arrival because of clock errors, in
ns.
"""
_MAX_BOOTS = 64
"""Maximum number of starts of a member whose messages are counted separately."""
_CDR_HEAD = b"\x00\x01"
"""First bytes of a message in plain little-endian CDR, the encoding of ROS 2."""
_RATE_TOLERANCE = 0.02
"""Maximum relative difference between a measured tick rate and that of the scenario."""
_RATE_SPAN_NS = 2 * NS_PER_S
"""Minimum time over which a tick rate is measured, in ns."""
_ACCOUNTS_SINCE = 3
"""First schema version whose logs state the message counts of every channel."""


@dataclass(frozen=True, repr=False)
class LogCheckResult(CheckReport):
    """Result of checking the files of one log for damage and missing messages.

    Printed by `trilat log check`.

    Attributes:
        findings: The result of each check, with the problems that it found.
        files: Names of the files.
        ours: True if the files are a log of trilat-net. Otherwise they are other MCAP files,
            and only their bytes were checked.
    """

    files: list[str]
    ours: bool

    def to_dict(self) -> dict[str, Any]:
        """Returns the result of all checks, with the keys of `trilat log check --json`.

        The entry "kind" is "trilat" for a log of this program and "mcap" for another MCAP file,
        of which only the bytes were checked.
        """
        kind = "trilat" if self.ours else "mcap"
        return {
            "files": self.files,
            "kind": kind,
            "sound": self.passed,
            "checks": self.to_rows(),
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns the results of all checks as plain values for JSON, with one row per check.

        A row contains the name of the check, whether it passed, and its problems with their
        positions in the files.
        """
        return [
            {
                "check": finding.check,
                "passed": finding.passed,
                "text": finding.text,
                "places": [position._asdict() for position in finding.places],
                "wrong": finding.wrong,
            }
            for finding in self.findings
        ]

    def check_signatures(self, key_file: Path, progress: Progress | None = None) -> None:
        """Checks the signatures of the files as well, and adds the result to the findings.

        Args:
            key_file: Path of the public key file of a signer whom the user trusts.
            progress: Function that is called after every record of a log.

        Raises:
            LogError: A log cannot be read.
            UsageError: The key file is not a public key.
        """
        from .log_signature import check_signatures  # loads the library `cryptography`

        self.findings.append(check_signatures(list(map(Path, self.files)), key_file, progress))


def check_file(*files: str | Path, progress: Progress | None = None) -> LogCheckResult:
    """Checks that a log is well-formed, complete and consistent, like `trilat log check`.

    Every byte of the file, or of all parts of the log, is checked.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("sound.mcap")
    >>> tn.check_file(path).passed
    True

    Args:
        files: Path of the file, or paths of the parts of the log.
        progress: Function that is called repeatedly with the number of bytes read and the
            total.

    Raises:
        LogError: A file cannot be read, or does not belong to the session of the previous
            files.
    """
    check = _SessionCheck()
    paths = [Path(file) for file in files]
    try:
        total = sum(path.stat().st_size for path in paths)
        bytes_before = 0  # size of the parts that have been read, for the progress
        for path in sorted(paths, key=lambda path: path.name):
            with open_regular(path) as stream:
                check.read(str(path), stream, shift_progress(progress, bytes_before, total))
            bytes_before += path.stat().st_size
    except OSError as error:
        name = error.filename or " ".join(map(str, paths))
        hint = describe_unfinished(Path(name))
        raise LogError(f"{name} cannot be read: {error.strerror}{hint}") from None
    return LogCheckResult(
        findings=list(check.findings()),
        files=[path.as_posix() for path in paths],
        ours=check.ours,
    )


class _ChannelCheck:
    """Checks the messages of one channel of a session: their numbers, schema and time stamps.

    Args:
        key: Names of the session, of the member and of the channel. The member is a site or the
            recorder.
        about: Metadata of the session.
        scenario: Scenario of the session. None if it cannot be read.
        findings: Results of the checks, to which problems are added.
        accounts: Counts of received and missing messages of the session, to which the messages
            are added.

    Attributes:
        member: Name of the member.
        kind: Name of the channel: "state" (records), "link" (statistics), "event" or "stats".
        rate_hz: Tick rate of the site, in Hz; 0 for the recorder.
        received: Number of messages, not counting duplicates.
        boots: Random numbers that identify the starts of the member's process.
        first: Number and sending time of the message with the lowest number. None if there is
            no message.
        last: Number and sending time of the message with the highest number. None if there is
            no message.
    """

    def __init__(
        self,
        key: topics.KeyParts,
        about: Mapping[str, str],
        scenario: Scenario | None,
        findings: Findings,
        accounts: SessionAccounts,
    ) -> None:
        """Prepares the check of one channel of a log. No message has been checked yet."""
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
        # Messages of the present file, by the boot of the member.
        self._in_file: dict[int, Account] = {}
        # Name of the present file.
        self._file = ""
        # Arrival time of the previous message.
        self._log_ns = 0

    @property
    def name(self) -> str:
        """Short name of the channel for messages to the user, such as "m1/state".

        Consists of the publishing member ("m1") and the kind of message ("state").
        """
        return f"{self.member}/{self.kind}"

    def begin(self, file: str, channel: ChannelInfo) -> None:
        """Starts the check of the channel in the next file of the log.

        A log may be divided into several files. The description of the channel in the file
        (schema, encoding and metadata) is checked immediately. The messages of the file are
        passed to `check_message` afterwards.

        Args:
            file: Name of the file.
            channel: Description of the channel in the file.
        """
        self._in_file = defaultdict(Account)
        self._file = file
        self._log_ns = 0
        fault = self._find_schema_fault(channel)
        if fault:
            self._add("schema", None, fault)

    def _find_schema_fault(self, channel: ChannelInfo) -> str:
        """Returns a description of the first fault in a file's description of the channel.

        The description of the channel must state the schema (the fields of the messages) used
        by this version of the log, its encoding, and the tick rate of the site. Empty if there
        is no fault.
        """
        kind = CHANNEL_TYPES[self.kind]
        if not channel.schema:
            return "has no schema"
        if channel.encoding != "msgpack" or channel.schema_encoding != "jsonschema":
            return (
                f"must be msgpack with jsonschema, not {channel.encoding} with "
                f"{channel.schema_encoding}"
            )
        expected_schema = f"trilat.{kind.__name__}.v{self._version}"
        if channel.schema != expected_schema:
            return f"has the schema {channel.schema}, not {expected_schema}"
        if self._version == messages.VERSION:
            released_schema = json.dumps(messages.json_schema(kind)).encode()
            if channel.schema_data != released_schema:
                return f"the schema {channel.schema} differs from its released version"
        stated_rate = channel.metadata.get("rate_hz", str(self.rate_hz))
        if self.kind == topics.STATE and stated_rate != str(self.rate_hz):
            return f"states {stated_rate} Hz, but the scenario states {self.rate_hz}"
        return ""

    def check_message(self, stored: McapMessage, offset: int) -> None:
        """Checks that a message can be decoded, is in order, and has a plausible time stamp.

        The sender, number and sending time in the message must match those that the file states
        for it. Problems are added to the findings.

        Args:
            stored: The message, with its times and its sequence number in the file.
            offset: Offset of the message in the file, or of the chunk that contains it.
        """
        kind: Any = CHANNEL_TYPES[self.kind]
        try:
            message = decode(stored.payload, kind, messages.READABLE, self._layout)
        except WireError as error:
            self._add("schema", offset, str(error))
            return

        identity = MessageIdentity.of_message(message, self.rate_hz)
        number = identity.number
        sequence = identity.sequence
        if self.kind == topics.STATS:
            # The recorder's statistics contain no number. Their position in the channel is used
            # instead.
            number = self._in_file[message.boot].expected
            sequence = number
        if message.v != self._version:
            text = f"a message has version {message.v}, but the log has version {self._version}"
            self._add("schema", offset, text)
        if identity.sender != self.member:
            self._add("schema", offset, f"a message states the sender {identity.sender[:40]!r}")

        if number >= 0:
            # A file stores the sequence number in 32 bits.
            if stored.sequence != sequence & 0xFFFFFFFF:
                text = (
                    f"message {sequence} is stored with the sequence number {stored.sequence}"
                )
                self._add("sequence", offset, text)
            self._count(message, number, stored.publish_time_ns, offset)
        elif isinstance(message, messages.Event):
            # Events have no number before version 3 of the schema.
            self._accounts.apply_event(message)
        self._check_times(stored, number, identity.sent_ns, offset)

    def _add(self, check: str, offset: int | None, text: str) -> None:
        """Adds a problem of this channel to the finding of a check."""
        self._findings[check].add(self._file, offset, f"{self.name}: {text}")

    def _count(self, message: AnyMessage, number: int, publish_ns: int, offset: int) -> None:
        """Counts a numbered message, so that missing and repeated messages are noticed.

        A number that occurs twice in one file is reported as a problem. Numbers are counted
        separately for each start of the sender, which is identified by the random number
        `boot`.

        Args:
            message: The message.
            number: Number of the message in its channel.
            publish_ns: Sending time of the message in Unix time, in ns.
            offset: Offset of the message in the file.
        """
        if message.boot not in self.boots and len(self.boots) >= _MAX_BOOTS:
            self._add("sequence", offset, f"there were more than {_MAX_BOOTS} starts")
            return
        self.boots.add(message.boot)

        # Two parts of a log may contain the same message, but one file may not.
        if not self._in_file[message.boot].receive(number):
            self._add("sequence", offset, f"message {number} occurs twice")
        if isinstance(message, messages.Event):
            is_new = self._accounts.receive_event(self._topic, number, message)
        elif self.kind == topics.STATS:
            is_new = True
        else:
            is_new = self._accounts.count_message(self._topic, number)
        self.received += is_new

        # The changes in a record state how many ticks the site skipped before it.
        if self.rate_hz and isinstance(message, messages.State) and message.cmd:
            skipped = count_skipped_ticks(message.cmd)
            self._accounts.mark_skipped_ticks(self.member, message.tick, skipped)

        numbered_time = (number, publish_ns)
        if self.first is None or numbered_time < self.first:
            self.first = numbered_time
        if self.last is None or numbered_time > self.last:
            self.last = numbered_time

    def _check_times(
        self, stored: McapMessage, number: int, stated_ns: int | None, offset: int
    ) -> None:
        """Checks the arrival and sending times that the file states for a message.

        Arrival times must not decrease. The sending time must be that of the message itself,
        and not later than the arrival by more than the clocks can differ.

        Args:
            stored: The message, with its times in the file.
            number: Number of the message, for the error messages.
            stated_ns: Sending time stated by the message, in ns after the start of the session.
                None if it states no time.
            offset: Offset of the message in the file.
        """
        log_ns = stored.log_time_ns
        publish_ns = stored.publish_time_ns
        if log_ns < self._log_ns:
            text = f"log_time goes back by {self._log_ns - log_ns} ns at message {number}"
            self._add("times", offset, text)
        self._log_ns = log_ns

        sent_ns = publish_ns
        if stated_ns is not None:
            # The file stores the time as an unsigned number of 64 bits.
            sent_ns = min(max(0, self._epoch_ns + stated_ns), MAX_TIME_NS)
        if publish_ns != sent_ns:
            text = (
                f"message {number} was sent at {sent_ns} ns, but is stored with {publish_ns} ns"
            )
            self._add("times", offset, text)
        elif publish_ns > log_ns + _MAX_AHEAD_NS:
            ahead_s = (publish_ns - log_ns) / NS_PER_S
            text = f"message {number} arrived {ahead_s:.1f} s before it was sent"
            self._add("times", offset, text)


def _read_checked(reader: McapReader, structure: FileCheck) -> Iterator[McapMessage]:
    """Yields the messages of a file, after checking the record that contains them.

    Args:
        reader: Reader of the file.
        structure: Check of the file's bytes.
    """
    for item in reader.scan():
        if isinstance(item, ScannedRecord):
            structure.check_record(item)
            yield from reader.read_record(item)


def _parse_number(about: Mapping[str, str], key: str) -> int:
    """Returns an integer from the metadata, or 0 if the entry is missing or not an integer."""
    text = about.get(key, "")
    return int(text) if re.fullmatch(r"\d{1,19}", text) else 0


class _SessionCheck:
    """Checks one session, whose log is one file or several parts.

    The caller passes the files to `read`, one after another, and then obtains the results from
    `findings`.

    Attributes:
        ours: True if a file is a log of trilat-net, False for any other MCAP file.
        channels: Maps each topic to the check of its channel.
    """

    def __init__(self) -> None:
        """Prepares the check of all files of a session. No file has been checked yet."""
        self.ours = False
        self.channels: dict[str, _ChannelCheck] = {}
        self._findings = Findings()
        self._counts: Counter[str] = Counter()
        self._scenario: Scenario | None = None
        self._about: dict[str, str] = {}
        # Counts of the messages that the files contain.
        self._counted = SessionAccounts("", None)
        # Counts that the recorder states at the end of the last file, by topic.
        self._accounts: dict[str, str] = {}
        # True if one of the files contains the beginning of the session.
        self._first_part = False
        # Number of files of the session, and of those that are parts of a log.
        self._files = 0
        self._parts = 0
        # Number of messages that were written for viewers.
        self._views = 0
        # Version of the schema.
        self._version = 0
        # Name of the present file.
        self._file = ""
        # Result of the comparison of the last file with its digests.
        self._chain_text = ""

    def read(self, file: str, stream: BinaryIO, progress: Progress | None = None) -> None:
        """Checks every byte of one file of the log, and its messages.

        Problems are collected, and returned by `findings` after the last file.

        Args:
            file: Name of the file.
            stream: The file, opened for reading.
            progress: Function that is called repeatedly with the number of bytes read and the
                total.

        Raises:
            LogError: The file does not belong to the session of the previous files.
        """
        reader = McapReader(stream, file, progress, kept=False)
        structure = FileCheck(file, reader.scanner, self._findings)
        if reader.scanner.begins:
            self._read_messages(file, reader, structure)
        structure.finish()
        self._counts += structure.counts

    def _read_messages(self, file: str, reader: McapReader, structure: FileCheck) -> None:
        """Checks all messages of a file, and compares them with the digests in the file.

        Args:
            file: Name of the file.
            reader: Reader of the file.
            structure: Check of the file's bytes.

        Raises:
            LogError: The file does not belong to the session of the previous files.
        """
        checks: dict[str, _ChannelCheck | None] = {}
        self._file = file
        has_begun = False
        for message in _read_checked(reader, structure):
            if not has_begun:
                # The reader has read the metadata when it yields the first message.
                has_begun = True
                self._begin_file(reader)
            topic = message.topic
            if not self.ours or not topic:
                continue
            try:
                check = checks[topic]
            except KeyError:
                check = self._begin_channel(reader.channels[topic])
                checks[topic] = check
            if check is not None:
                check.check_message(message, reader.offset)
            elif topic.startswith(VIZ_ROOT):
                self._views += 1
                if message.payload[:2] != _CDR_HEAD:
                    self._findings["schema"].add(
                        file, reader.offset, f"{topic[:80]}: a message is not encoded in CDR"
                    )
        if not has_begun:
            self._begin_file(reader)

        self._accounts = reader.metadata.get(ACCOUNTS, {})
        chain = reader.judge_digest()
        self._chain_text = chain.text
        if not chain.passed:
            self._findings["chain"].add(file, None, self._chain_text)

    def _begin_file(self, reader: McapReader) -> None:
        """Prepares the check of a file, once its metadata and its scenario have been read.

        The metadata must show that the files of a log belong to one session. The files, and
        those that are parts of a log, are counted, because a recorder can divide a log into
        several files. The scenario is checked too. For the first file, the counts of the
        messages are prepared.

        Does nothing if neither this file nor an earlier one is a log of trilat-net, in which
        case `ours` remains False.

        Args:
            reader: Reader of the file.

        Raises:
            LogError: The file does not belong to the session of the previous files.
        """
        about = reader.metadata.get(SESSION, {})
        has_metadata = {"session", "driver"} <= about.keys()
        is_session_log = has_metadata and SCENARIO in reader.attachments
        if not is_session_log:
            if self.ours:
                raise LogError(
                    f"{self._file} is not a part of the same log as the previous files; check "
                    "this file separately"
                )
            return
        identifying_keys = ("session", "epoch_unix_ns", "scenario_sha256")
        is_other_session = any(
            about.get(key) != self._about.get(key) for key in identifying_keys
        )
        if self.ours and is_other_session:
            raise LogError(
                f"{self._file} belongs to another session than the previous files; check this "
                "file separately"
            )

        is_first_file = not self.ours
        self.ours = True
        self._about = about
        self._version = _parse_number(about, "schema_version")
        self._files += 1
        if PART in reader.metadata:
            self._parts += 1
        # Number of the part, as text. It is empty if the log is not divided.
        part_index = reader.metadata.get(PART, {}).get("index", "")
        contains_beginning = part_index in ("", "1")
        self._first_part |= contains_beginning
        self._check_scenario(reader.attachments[SCENARIO])
        if is_first_file:
            self._open_accounts(about["session"])

    def _open_accounts(self, session: str) -> None:
        """Prepares to count the messages published by the sites of the session.

        This happens before the first record is read, because an event or statistics may state
        how many records there must be, even if the file contains none.
        """
        continued = not self._first_part
        self._counted = SessionAccounts(session, self._scenario, continued=continued)
        names = self._scenario.names if self._scenario else ()
        for name in names:
            for channel in (topics.STATE, topics.LINK):
                self._counted.open_channel("/" + topics.key(session, name, channel))

    def _check_scenario(self, text: bytes) -> None:
        """Checks the scenario in the log, and compares it with the metadata of the session.

        The metadata contain the SHA-256 hash of the scenario, its name, its seed and its sites.

        Args:
            text: Encoded text of the scenario.
        """
        finding = self._findings["scenario"]
        metadata = self._about
        actual_sha256 = hashlib.sha256(text).hexdigest()
        stated_sha256 = metadata.get("scenario_sha256", "")
        if actual_sha256 != stated_sha256:
            finding.add(
                self._file,
                None,
                f"its SHA-256 is {actual_sha256[:16]}, but the session names "
                f"{stated_sha256[:16]}",
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
            if metadata.get(key) != value:
                stated_value = metadata.get(key, "")[:40]
                finding.add(
                    self._file,
                    None,
                    f"has the {key} {value}, but the session states {stated_value!r}",
                )

    def _begin_channel(self, channel: ChannelInfo) -> _ChannelCheck | None:
        """Begins the check of a channel in the current file, when its first message is read.

        The description of the channel (its schema, encoding and metadata) is checked
        immediately, and problems are added to the finding "schema". There are three kinds of
        channels: channels for viewers, channels of the session's members, and channels of other
        programs. Messages are compared with the session only for the members' channels.

        Args:
            channel: Description of the channel in the current file.

        Returns:
            The check of the messages, which is continued from the previous file of the log.
            None if the channel does not belong to a member of this session.
        """
        topic = channel.topic
        shown_topic = topic[:80]  # a damaged file may contain a topic of any length
        finding = self._findings["schema"]
        is_for_viewers = topic.startswith(VIZ_ROOT)
        if is_for_viewers:
            self._check_view_channel(channel)
            return None

        key = topics.parse_key(topic.removeprefix("/"))
        # A key with a boot only announces the presence of a process, and has no messages.
        is_of_member = (
            key is not None
            and key.channel in CHANNEL_TYPES
            and key.session == self._about["session"]
            and not key.boot
        )
        if key is None or not is_of_member:
            if not channel.schema:
                finding.add(self._file, None, f"{shown_topic}: has no schema")
            return None

        if topic not in self.channels:
            if self._scenario and key.member not in (*self._scenario.sites, topics.RECORDER):
                finding.add(
                    self._file, None, f"{shown_topic}: the scenario has no member of this name"
                )
            self._counted.open_channel(topic)
            self.channels[topic] = _ChannelCheck(
                key=key,
                about=self._about,
                scenario=self._scenario,
                findings=self._findings,
                accounts=self._counted,
            )
        self.channels[topic].begin(self._file, channel)
        return self.channels[topic]

    def _check_view_channel(self, channel: ChannelInfo) -> None:
        """Checks that a channel for viewers has a standard ROS 2 type, encoded in CDR."""
        encodings = (channel.encoding, channel.schema_encoding)
        is_cdr = encodings == (cdr.ENCODING, cdr.SCHEMA_ENCODING)
        if not is_cdr or channel.schema_data != cdr.ROS2_SCHEMAS.get(channel.schema):
            schema = channel.schema[:80] or "no schema"
            text = f"{channel.topic[:80]}: {schema} is not a standard message type of ROS 2"
            self._findings["schema"].add(self._file, None, text)

    def findings(self) -> Iterator[Finding]:
        """Completes all checks after the files have been read, and yields their results.

        If the files contain no session of trilat-net, only the checks of the file format are
        yielded, plus the result "chain" if checksums show that the session was removed from the
        file.
        """
        counts = self._counts
        findings = self._findings
        messages = counts["messages"]
        chunks = counts["chunks"]
        yield findings["whole"].conclude(f"finished, {counts['bytes'] / 1e6:.1f} MB")
        yield findings["checksums"].conclude(f"{counts['crcs']} compared, all agree")
        content = f"{count_nouns(messages, 'message')} in {count_nouns(chunks, 'chunk')}"
        yield findings["records"].conclude(f"{content}, as the format requires")
        yield findings["index"].conclude("agrees with the data")
        if not self.ours:
            if "chain" in findings:
                yield findings["chain"].conclude("")
            return

        yield self._check_sequence()
        yield self._check_accounts()
        yield findings["chain"].conclude(self._chain_text)
        kinds = f"every message is one of version {self._version}"
        views = f", and {count_nouns(self._views, 'view')}" if self._views else ""
        yield findings["schema"].conclude(kinds + views)
        yield findings["times"].conclude(
            "log times never go back, publish times are the senders'"
        )
        yield self._check_rates()
        scenario = self._scenario.name if self._scenario else ""
        digest = self._about.get("scenario_sha256", "")[:16]
        text = f"{scenario}, SHA-256 {digest}, as the session names it"
        yield findings["scenario"].conclude(text)

    def _check_sequence(self) -> Finding:
        """Returns the finding about missing and repeated messages, based on their numbers.

        The recorder's statistics are not counted, because they are not numbered.
        """
        finding = self._findings["sequence"]
        missing = 0
        reordered = 0
        missing_ranges = []
        for topic, check in self.channels.items():
            if check.kind == topics.STATS:
                continue
            for first, last in self._counted.list_gaps(topic):
                missing += last - first + 1
                numbers = f"{first}-{last}" if last > first else f"{first}"
                missing_ranges.append(f"{check.name} {numbers}")
            reordered += sum(account.reordered for account in self._counted.list_starts(topic))

        # The text of the finding, and a problem for each range.
        received = sum(check.received for check in self.channels.values())
        channels = count_nouns(len(self.channels), "channel")
        summary = f"{count_nouns(received, 'message')} of {channels}"
        if missing:
            plural = "s" if len(missing_ranges) > 1 else ""
            summary += f", {missing} missing in {len(missing_ranges)} range{plural}"
        elif finding.passed:
            summary += ", none missing, none twice"
        if not finding.passed:
            summary += f"; {finding.summary()}"
        if reordered:
            summary += f"; {reordered} came late"
        if self._needs_end_events and self._counted.unknown_ends:
            summary += f"; {describe_unknown_ends(self._counted.unknown_ends)}"
        for missing_range in missing_ranges:
            finding.add("", None, f"missing {missing_range}")  # concerns the whole log
        finding.text = summary
        return finding

    @property
    def _needs_end_events(self) -> bool:
        """True if the checked files must contain the "end" event of every site.

        The event may be missing if only one of several parts of a log is checked, or if the
        recorder was configured not to record events.
        """
        session = self._about["session"]
        channel_filter = ChannelFilter.parse_facts(self._about)
        names = self._scenario.names if self._scenario else ()
        event_topics = [topics.key(session, name, topics.EVENT) for name in names]
        are_events_recorded = all(channel_filter.accepts(topic) for topic in event_topics)
        is_single_part = self._files == self._parts == 1
        return are_events_recorded and not is_single_part

    def _check_accounts(self) -> Finding:
        """Compares the accounts, the recorder's message counts, with the messages.

        At the end of a file, the recorder states for each channel how many messages it received
        and how many are missing. The comparison is impossible if these counts include messages
        of parts that were not read, or if several recorders wrote the log. The recorder's own
        statistics are not numbered, so their counts cannot be compared. Since version
        `_ACCOUNTS_SINCE` of the schema, every channel must have an account.

        Returns:
            A finding with one problem for each channel whose account is wrong or missing.
        """
        finding = self._findings["accounts"]
        if not self._accounts:
            return finding.conclude("there are none: the file was not finished")
        recorder_boots: set[int] = set()
        for check in self.channels.values():
            if check.member == topics.RECORDER:
                recorder_boots |= check.boots
        had_several_recorders = len(recorder_boots) > 1
        if not self._first_part or had_several_recorders:
            return finding.conclude("include other parts of the log, and were not compared")

        for topic, check in self.channels.items():
            stated = Account.parse_counts(self._accounts.get(topic, ""))
            if check.kind != topics.STATS:
                missing = sum(account.missing for account in self._counted.list_starts(topic))
                counted = {"received": check.received, "missing": missing}
                for name, stated_count in stated.items():
                    if stated_count != counted[name]:
                        text = f"{check.name}: the account states {stated_count} {name}"
                        # The problem concerns the whole log: no file, no offset.
                        finding.add("", None, f"{text}, but the file has {counted[name]}")
            must_have_account = self._version >= _ACCOUNTS_SINCE
            if not stated and must_have_account:
                finding.add("", None, f"{check.name}: has no account")
        return finding.conclude("agree with the messages")

    def _check_rates(self) -> Finding:
        """Compares the rates at which the sites sent records with the rates of the scenario.

        The number of a record is its tick. The mean rate is therefore the difference between
        the numbers of the first and the last record, divided by the time between them. It may
        deviate by the fraction `_RATE_TOLERANCE`. Records spanning less than `_RATE_SPAN_NS`
        are not judged.

        Returns:
            A finding with one problem for each site whose rate is wrong.
        """
        finding = self._findings["rates"]
        texts = []
        for check in self.channels.values():
            is_site_record = check.kind == topics.STATE and bool(check.rate_hz)
            if not is_site_record or check.first is None or check.last is None:
                continue
            first_tick, first_sent_ns = check.first
            last_tick, last_sent_ns = check.last
            span_ns = last_sent_ns - first_sent_ns
            if span_ns < _RATE_SPAN_NS:
                continue
            rate_hz = (last_tick - first_tick) * NS_PER_S / span_ns
            texts.append(f"{check.member} {rate_hz:.1f} Hz")
            relative_error = rate_hz / check.rate_hz - 1
            if abs(relative_error) > _RATE_TOLERANCE:
                sent = f"{check.member} sent {rate_hz:.1f} records a second"
                # The problem concerns the whole log: no file, no offset.
                finding.add("", None, f"{sent}, but the scenario says {check.rate_hz}")
        return finding.conclude(", ".join(texts) or "the log is too short to measure them")
