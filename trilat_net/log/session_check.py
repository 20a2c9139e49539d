"""Check of a log: bytes of its files, completeness of its session, agreement with scenario and accounts.

Invariant: one finding per check, with the places where it fails; missing messages are named range by
range. Any MCAP file is checked for its bytes, only a trilat-net log for its content. Nothing is
executed: that is the task of `verify`.
"""

import hashlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

from ..core.ticks import NS_PER_S
from ..errors import LogError, ScenarioError
from ..net import topics
from ..scenario import Scenario, parse_embedded
from .channel_check import ChannelCheck, ChannelProblems
from .log_layout import ACCOUNTS, CHANNEL_TYPES, PART, SCENARIO, SESSION, VIZ_ROOT
from .mcap_check import CheckFinding, McapCheck, ProblemList
from .mcap_reader import ChannelInfo, McapReader, Progress, shift_progress
from .ros2 import cdr

_CDR_HEAD = b"\x00\x01"
_RATE_TOLERANCE = 0.02
_RATE_SPAN_NS = 2 * NS_PER_S
"""A rate is computed over no shorter a time."""
_ACCOUNTS_SINCE = 3
"""First version whose logs have an account of every channel."""


class LogCheckResult(NamedTuple):
    """Result of a check of files.

    Attributes:
        findings: one per check.
        ours: True if they are a trilat-net log; else only their bytes were checked.
    """

    findings: list[CheckFinding]
    ours: bool

    @property
    def passed(self) -> bool:
        """True if every check passed."""
        return all(finding.passed for finding in self.findings)


def check_log(paths: Sequence[Path], progress: Progress | None = None) -> LogCheckResult:
    """Checks every byte of a file, or of files that are parts of one log.

    Raises:
        LogError: a file cannot be read, or is of another session than the files before it.
    """
    files, session = McapCheck(), SessionCheck()
    try:
        total = 2 * sum(path.stat().st_size for path in paths)
        before = 0
        for path in sorted(paths, key=lambda path: path.name):
            size = path.stat().st_size
            with path.open("rb") as stream:
                if files.read(str(path), stream, shift_progress(progress, before, total)):
                    stream.seek(0)
                    session.read(str(path), stream, shift_progress(progress, before + size, total))
            before += 2 * size
    except OSError as error:
        name = error.filename or " ".join(map(str, paths))
        raise LogError(f"{name}: cannot be read: {error.strerror}") from None
    return LogCheckResult([*files.findings(), *(session.findings() if session.ours else ())], session.ours)


class SessionCheck:
    """Check of the messages of one session, in one file or in its parts.

    Attributes:
        ours: True if there is a trilat-net log at all.
        channels: the checks of its channels, by topic.
    """

    def __init__(self) -> None:
        self.ours = False
        self.channels: dict[str, ChannelCheck] = {}
        self._problems = ChannelProblems(ProblemList(), ProblemList(), ProblemList())
        self._scenario_problems = ProblemList()
        self._scenario: Scenario | None = None
        self._about: dict[str, str] = {}
        self._parts: list[dict[str, str]] = []
        self._accounts: dict[str, str] = {}  # of the last file
        self._views = 0
        self._file = ""

    def read(self, file: str, stream: BinaryIO, progress: Progress | None = None) -> None:
        """Checks all messages of a file.

        Raises:
            LogError: it is of another session than the files before it.
        """
        reader = McapReader(stream, file, progress, kept=False)
        checks: dict[str, ChannelCheck | None] = {}
        self._file, begun = file, False
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
                    self._problems.schema.add(file, reader.offset, f"{topic[:80]}: a message is no CDR")
        if not begun:
            self._begin(reader)
        self._accounts = reader.metadata.get(ACCOUNTS, {})

    def _begin(self, reader: McapReader) -> None:
        about = reader.metadata.get(SESSION, {})
        if not {"session", "driver"} <= about.keys() or SCENARIO not in reader.attachments:
            if self.ours:
                raise LogError(f"{self._file}: is no part of that log; look at it alone")
            return
        same = ("session", "epoch_unix_ns", "scenario_sha256")
        if self.ours and any(about.get(key) != self._about.get(key) for key in same):
            raise LogError(f"{self._file}: is of another session; look at it alone")
        self.ours, self._about = True, about
        self._parts.append(reader.metadata.get(PART, {}))
        self._check_scenario(reader.attachments[SCENARIO])

    def _check_scenario(self, text: bytes) -> None:
        problems, about = self._scenario_problems, self._about
        digest, stated = hashlib.sha256(text).hexdigest(), about.get("scenario_sha256", "")
        if digest != stated:
            problems.add(self._file, None, f"its SHA-256 is {digest[:16]}, the session names {stated[:16]}")
        try:
            self._scenario = scenario = parse_embedded(text.decode(), "scenario")
        except (ScenarioError, UnicodeDecodeError) as error:
            problems.add(self._file, None, f"cannot be read: {error}")
            return
        facts = {"scenario": scenario.name, "seed": str(scenario.seed), "sites": " ".join(scenario.names)}
        for key, value in facts.items():
            if about.get(key) != value:
                text_there = about.get(key, "")[:40]
                problems.add(self._file, None, f"has {key} {value}, the session {text_there!r}")

    def _session_number(self, key: str) -> int:
        text = self._about.get(key, "")
        return int(text) if re.fullmatch(r"\d{1,19}", text) else 0

    def _begin_channel(self, channel: ChannelInfo) -> ChannelCheck | None:
        """Returns the check of a channel in this file; None if it is none of the session's own."""
        topic, problems = channel.topic, self._problems.schema
        key = topics.parse_key(topic.removeprefix("/"))
        if topic.startswith(VIZ_ROOT):
            is_cdr = (channel.encoding, channel.schema_encoding) == (cdr.ENCODING, cdr.SCHEMA_ENCODING)
            if not is_cdr or channel.schema_data != cdr.ROS2_SCHEMAS.get(channel.schema):
                schema = channel.schema[:80] or "no schema"
                problems.add(self._file, None, f"{topic[:80]}: {schema} is none of the standard ones")
            return None
        if (
            key is None
            or key.channel not in CHANNEL_TYPES
            or key.session != self._about["session"]
            or key.boot
        ):
            if not channel.schema:
                problems.add(self._file, None, f"{topic[:80]}: has no schema")
            return None
        check = self.channels.get(topic)
        if check is None:
            check = self.channels[topic] = self._make_channel_check(topic, key)
        check.begin(self._file, channel)
        return check

    def _make_channel_check(self, topic: str, key: topics.KeyParts) -> ChannelCheck:
        sites = self._scenario.sites if self._scenario else {}
        if self._scenario and key.member not in (*sites, topics.RECORDER):
            text = f"{topic[:80]}: the scenario has no such member"
            self._problems.schema.add(self._file, None, text)
        rate_hz = sites[key.member].rate_hz if key.member in sites else 0
        epoch_ns, version = self._session_number("epoch_unix_ns"), self._session_number("schema_version")
        return ChannelCheck(key.member, key.channel, rate_hz, epoch_ns, version, self._problems)

    def findings(self) -> Iterator[CheckFinding]:
        """Yields the results, once all files were read."""
        self._expect_all()
        yield self._check_sequence()
        yield self._check_accounts()
        kinds = f"every message is one of version {self._session_number('schema_version')}"
        views = f", and {self._views} views" if self._views else ""
        yield self._problems.schema.finding("schema", kinds + views)
        times = "log times never go back, publish times are the senders'"
        yield self._problems.times.finding("times", times)
        yield self._check_rates()
        scenario = self._scenario.name if self._scenario else ""
        digest = self._about.get("scenario_sha256", "")[:16]
        text = f"{scenario}, SHA-256 {digest}, as the session names it"
        yield self._scenario_problems.finding("scenario", text)

    def _expect_all(self) -> None:
        """Counts as missing what members that stated their number of ticks published and is not there."""
        ticks = {check.member: check.ticks for check in self.channels.values() if check.ticks is not None}
        for check in self.channels.values():
            if check.kind in (topics.STATE, topics.LINK) and check.member in ticks:
                most = self._scenario.ticks(check.member) if self._scenario and check.rate_hz else 0
                check.expect(min(ticks[check.member], most))

    @property
    def _first_part(self) -> bool:
        """True if the files begin with the session."""
        return not self._parts or any(part.get("index", "") in ("", "1") for part in self._parts)

    def _check_sequence(self) -> CheckFinding:
        problems, missing, reordered = self._problems.sequence, 0, 0
        gaps = []
        for check in self.channels.values():
            for first, last in check.gaps(whole=self._first_part):
                missing += last - first + 1
                gaps.append(f"{check.name} {first}-{last}" if last > first else f"{check.name} {first}")
            reordered += sum(account.reordered for account in check.accounts.values())
        received = sum(check.received for check in self.channels.values())
        text = f"{received} messages of {len(self.channels)} channels"
        if missing:
            text += f", {missing} missing in {len(gaps)} range{'s' * (len(gaps) > 1)}"
        elif not problems.wrong:
            text += ", none missing, none twice"
        if problems.wrong:
            text += f"; {problems.summary()}"
        if reordered:
            text += f"; {reordered} came late"
        for gap in gaps:
            problems.add("", None, f"missing {gap}")
        return CheckFinding("sequence", not problems.wrong, text, problems.places, problems.wrong)

    def _check_accounts(self) -> CheckFinding:
        problems = ProblemList()
        if not self._accounts:
            return problems.finding("accounts", "there are none: the file was not finished")
        recorders = {
            boot
            for check in self.channels.values()
            if check.member == topics.RECORDER
            for boot in check.accounts
        }
        if not self._first_part or len(recorders) > 1:
            text = "tell of parts that are not here, and were not compared"
            return problems.finding("accounts", text)
        for topic, check in self.channels.items():
            account = self._accounts.get(topic, "")
            stated = {word: int(n) for word, n in re.findall(r"(received|missing) (\d{1,15})\b", account)}
            there = {"received": check.received, "missing": check.missing}
            for word, count in stated.items():
                if check.kind != topics.STATS and count != there[word]:
                    text = f"{check.name}: {count} {word} by the account, {there[word]} by the file"
                    problems.add("", None, text)
            if not stated and self._session_number("schema_version") >= _ACCOUNTS_SINCE:
                problems.add("", None, f"{check.name}: has no account")
        return problems.finding("accounts", "agree with what is there")

    def _check_rates(self) -> CheckFinding:
        problems, texts = ProblemList(), []
        for check in self.channels.values():
            if check.kind != topics.STATE or check.first is None or check.last is None or not check.rate_hz:
                continue
            span_ns = check.last[1] - check.first[1]
            if span_ns < _RATE_SPAN_NS:
                continue
            rate_hz = (check.last[0] - check.first[0]) * NS_PER_S / span_ns
            texts.append(f"{check.member} {rate_hz:.1f} Hz")
            if abs(rate_hz / check.rate_hz - 1) > _RATE_TOLERANCE:
                text = (
                    f"{check.member} sent {rate_hz:.1f} records a second, the scenario says {check.rate_hz}"
                )
                problems.add("", None, text)
        return problems.finding("rates", ", ".join(texts) or "too short to tell")
