"""Check of a log: format of its files, completeness of its session, agreement with scenario and accounts.

Invariant: one finding per check, with the places where it fails; missing messages are named range by
range. Any MCAP file is checked for its format, only a trilat-net log for its content. Nothing is
executed: that is the task of `verify`.
"""

import hashlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ..core.ticks import NS_PER_S
from ..errors import LogError, ScenarioError
from ..net import topics
from ..scenario import Scenario, parse_embedded
from .channel_check import ChannelCheck, ChannelProblems, ProblemList
from .log_layout import ACCOUNTS, CHANNEL_TYPES, PART, SCENARIO, SESSION
from .mcap_doctor import FormatCheck
from .mcap_reader import Progress
from .ros2 import cdr

_VIEWS = "/viz/"
_CDR_HEADS = (b"\x00\x01\x00\x00", b"\x00\x00\x00\x00")
_RATE_TOLERANCE = 0.02
_RATE_SPAN_NS = 2 * NS_PER_S
"""A rate is judged over no shorter a time."""
_ACCOUNTS_SINCE = 3
"""First version whose logs account for every channel."""


class SessionFinding(NamedTuple):
    """How a check of a session came out."""

    check: str
    text: str
    tally: ProblemList


class SessionCheck:
    """The messages of one session, in one file or in its parts.

    Attributes:
        ours: whether there is a log of trilat-net at all.
        lanes: its channels, by topic.
    """

    def __init__(self) -> None:
        self.ours = False
        self.lanes: dict[str, ChannelCheck] = {}
        self._tallies = ChannelProblems(ProblemList(), ProblemList(), ProblemList())
        self._scenario_tally = ProblemList()
        self._scenario: Scenario | None = None
        self._about: dict[str, str] = {}
        self._parts: list[dict[str, str]] = []
        self._accounts: list[dict[str, str]] = []
        self._views = 0
        self._file = ""

    def read(self, file: str, structure: FormatCheck) -> None:
        """Looks at all of a file.

        Raises:
            LogError: it is of another session than the files before it.
        """
        lanes: dict[int, ChannelCheck | None] = {}
        self._file, begun = file, False
        for raw in structure.read():
            if not begun:
                begun = True
                self._begin(structure)
            try:
                lane = lanes[raw.channel]
            except KeyError:
                lane = lanes[raw.channel] = self._lane(structure, raw.channel)
            if lane is not None:
                lane.take(raw)
            elif self.ours and raw.channel in structure.channels:
                self._look_at_view(structure.channels[raw.channel].topic, raw.payload, raw.offset)
        if not begun:
            self._begin(structure)
        self._accounts.append(structure.metadata.get(ACCOUNTS, {}))

    def _begin(self, structure: FormatCheck) -> None:
        about = structure.metadata.get(SESSION, {})
        if not {"session", "driver"} <= about.keys() or SCENARIO not in structure.attachments:
            if self.ours:
                raise LogError(f"{self._file}: is no part of that log; look at it alone")
            return
        same = ("session", "epoch_unix_ns", "scenario_sha256")
        if self.ours and any(about.get(key) != self._about.get(key) for key in same):
            raise LogError(f"{self._file}: is of another session; look at it alone")
        self.ours, self._about = True, about
        self._parts.append(structure.metadata.get(PART, {}))
        self._look_at_scenario(structure.attachments[SCENARIO])

    def _look_at_scenario(self, text: bytes) -> None:
        tell, about = self._scenario_tally.tell, self._about
        digest = hashlib.sha256(text).hexdigest()
        if digest != about.get("scenario_sha256"):
            tell(
                self._file,
                None,
                f"its SHA-256 is {digest[:16]}, the session names {about.get('scenario_sha256', '')[:16]}",
            )
        try:
            self._scenario = parse_embedded(text.decode(), "scenario")
        except (ScenarioError, UnicodeDecodeError) as error:
            tell(self._file, None, f"cannot be read: {error}")
            return
        is_now = {
            "scenario": self._scenario.name,
            "seed": str(self._scenario.seed),
            "sites": " ".join(self._scenario.names),
        }
        for key, value in is_now.items():
            if about.get(key) != value:
                tell(self._file, None, f"has {key} {value}, the session {about.get(key, '')[:40]!r}")

    def _number(self, key: str) -> int:
        text = self._about.get(key, "")
        return int(text) if re.fullmatch(r"\d{1,19}", text) else 0

    def _lane(self, structure: FormatCheck, number: int) -> ChannelCheck | None:
        """Returns the lane of a channel; None where it is none of the session's own."""
        channel = structure.channels.get(number)
        if channel is None or not self.ours:
            return None
        where = topics.parse_key(channel.topic.removeprefix("/"))
        schema = structure.schemas.get(channel.schema_id)
        if channel.topic.startswith(_VIEWS):
            self._look_at_view_schema(channel, schema)
            return None
        if (
            where is None
            or where.channel not in CHANNEL_TYPES
            or where.session != self._about["session"]
            or where.boot
        ):
            if schema is None:
                self._tallies.schema.tell(self._file, None, f"{channel.topic[:80]}: has no schema")
            return None
        lane = self.lanes.get(channel.topic)
        if lane is None:
            lane = self.lanes[channel.topic] = self._new_lane(channel.topic, where)
        lane.begin(self._file)
        lane.look(channel, schema)
        return lane

    def _new_lane(self, topic: str, where: topics.KeyParts) -> ChannelCheck:
        sites = self._scenario.sites if self._scenario else {}
        known = where.member in sites or where.member == topics.RECORDER
        if not known and self._scenario:
            self._tallies.schema.tell(self._file, None, f"{topic[:80]}: the scenario has no such member")
        rate_hz = sites[where.member].rate_hz if where.member in sites else 0
        epoch_ns, version = self._number("epoch_unix_ns"), self._number("schema_version")
        return ChannelCheck(topic, where.member, where.channel, rate_hz, epoch_ns, version, self._tallies)

    def _look_at_view_schema(self, channel: object, schema: object) -> None:
        name = getattr(schema, "name", "")
        encodings = getattr(channel, "message_encoding", ""), getattr(schema, "encoding", "")
        if encodings != (cdr.ENCODING, cdr.SCHEMA_ENCODING) or getattr(
            schema, "data", b""
        ) != cdr.ROS2_SCHEMAS.get(name):
            topic = getattr(channel, "topic", "")[:80]
            self._tallies.schema.tell(
                self._file, None, f"{topic}: {name[:80] or 'no schema'} is none of the standard ones"
            )

    def _look_at_view(self, topic: str, payload: bytes, offset: int) -> None:
        if topic.startswith(_VIEWS):
            self._views += 1
            if payload[:2] != _CDR_HEADS[0][:2]:
                self._tallies.schema.tell(self._file, offset, f"{topic[:80]}: a message is no CDR")

    def judged(self) -> Iterator[SessionFinding]:
        """Yields how every check came out, once all files were read."""
        self._expect()
        yield self._sequence()
        yield self._accounts_agree()
        tallies = self._tallies
        kinds = f"every message is one of version {self._number('schema_version')}"
        views = f", and {self._views} views" if self._views else ""
        yield _judged("schema", kinds + views, tallies.schema)
        yield _judged("times", "log times never go back, publish times are the senders'", tallies.times)
        yield self._rates()
        scenario = self._scenario.name if self._scenario else ""
        digest = self._about.get("scenario_sha256", "")[:16]
        yield _judged(
            "scenario", f"{scenario}, SHA-256 {digest}, as the session names it", self._scenario_tally
        )

    def _expect(self) -> None:
        """Books what must exist because a member said its end."""
        made = {lane.member: lane.ends for lane in self.lanes.values() if lane.ends is not None}
        for lane in self.lanes.values():
            if lane.kind in (topics.STATE, topics.LINK) and (ticks := made.get(lane.member)) is not None:
                most = self._scenario.ticks(lane.member) if self._scenario and lane.rate_hz else 0
                lane.expect(min(ticks, most))

    @property
    def _first_part(self) -> bool:
        """True where the files begin with the session."""
        indexes = [part.get("index", "") for part in self._parts]
        return not any(indexes) or "1" in indexes or any(not index for index in indexes)

    def _sequence(self) -> SessionFinding:
        tally, missing, reordered = self._tallies.sequence, 0, 0
        lacking = []
        for lane in self.lanes.values():
            for first, last in lane.gaps(whole=self._first_part):
                missing += last - first + 1
                lacking.append(f"{lane.name} {first}-{last}" if last > first else f"{lane.name} {first}")
            reordered += sum(account.reordered for account in lane.accounts.values())
        twice = tally.wrong
        text = f"{sum(lane.received for lane in self.lanes.values())} messages of {len(self.lanes)} channels"
        if missing:
            text += f", {missing} missing in {len(lacking)} range{'s' * (len(lacking) > 1)}"
        elif not twice:
            text += ", none missing, none twice"
        if twice:
            text += f"; {tally.text()}"
        if reordered:
            text += f"; {reordered} came late"
        for name in lacking:
            tally.tell("", None, f"missing {name}")
        return SessionFinding("sequence", text, tally)

    def _accounts_agree(self) -> SessionFinding:
        tally = ProblemList()
        accounts = self._accounts[-1] if self._accounts else {}
        if not accounts:
            return SessionFinding("accounts", "there are none: the file was not finished", tally)
        recorders = {
            boot for lane in self.lanes.values() if lane.member == topics.RECORDER for boot in lane.accounts
        }
        if not self._first_part or len(recorders) > 1:
            return SessionFinding("accounts", "tell of parts that are not here, and were not compared", tally)
        for topic, lane in self.lanes.items():
            told = {
                word: int(n)
                for word, n in re.findall(r"(received|missing) (\d{1,15})\b", accounts.get(topic, ""))
            }
            is_there = {"received": lane.received, "missing": lane.missing}
            for word, count in told.items():
                if lane.kind != topics.STATS and count != is_there[word]:
                    tally.tell(
                        "", None, f"{lane.name}: {count} {word} by the account, {is_there[word]} by the file"
                    )
            if not told and self._number("schema_version") >= _ACCOUNTS_SINCE:
                tally.tell("", None, f"{lane.name}: has no account")
        return _judged("accounts", "agree with what is there", tally)

    def _rates(self) -> SessionFinding:
        tally, texts = ProblemList(), []
        for lane in self.lanes.values():
            if lane.kind != topics.STATE or lane.first is None or lane.last is None or not lane.rate_hz:
                continue
            span_ns = lane.last[1] - lane.first[1]
            if span_ns < _RATE_SPAN_NS:
                continue
            rate_hz = (lane.last[0] - lane.first[0]) * NS_PER_S / span_ns
            texts.append(f"{lane.member} {rate_hz:.1f} Hz")
            if abs(rate_hz / lane.rate_hz - 1) > _RATE_TOLERANCE:
                text = f"{lane.member} sent {rate_hz:.1f} records a second, the scenario says {lane.rate_hz}"
                tally.tell("", None, text)
        return _judged("rates", ", ".join(texts) or "too short to tell", tally)


def _judged(check: str, text: str, tally: ProblemList) -> SessionFinding:
    return SessionFinding(check, tally.text() if tally.wrong else text, tally)


MAX_LISTED_PROBLEMS = 1000
"""Problems that a finding keeps; more are counted."""


class ProblemPlace(NamedTuple):
    """Something wrong, and where.

    Attributes:
        file: in which file.
        offset: at which byte, or of the chunk that begins there; None where it is a matter of the whole.
        text: what is wrong.
    """

    file: str
    offset: int | None
    text: str

    def __str__(self) -> str:
        return self.text if self.offset is None else f"byte {self.offset}: {self.text}"


class CheckFinding(NamedTuple):
    """How one check came out.

    Attributes:
        check: its name: "whole", "checksums", "records", "index"; of our logs also "sequence", "accounts",
            "schema", "times", "rates", "scenario".
        passed: whether it passed.
        text: what was found.
        places: what is wrong, at most `MAX_TOLD`.
        wrong: how many things are wrong.
    """

    check: str
    passed: bool
    text: str
    places: list[ProblemPlace]
    wrong: int


class LogCheckResult(NamedTuple):
    """Files, judged.

    Attributes:
        findings: a check each.
        ours: whether they are a log of trilat-net; else only how they are built was judged.
    """

    findings: list[CheckFinding]
    ours: bool

    @property
    def passed(self) -> bool:
        """True where every check passed."""
        return all(finding.passed for finding in self.findings)


def check_log(paths: Sequence[Path], progress: Progress | None = None) -> LogCheckResult:
    """Looks at every byte of a file, or of files that are parts of one log.

    Args:
        paths: the files.
        progress: told how many bytes are looked at, and how many there are in all.

    Raises:
        LogError: a file cannot be read.
    """
    session = SessionCheck()
    files: list[tuple[str, FormatCheck]] = []
    total = sum(_size(path) for path in paths)
    for path in sorted(paths, key=lambda path: path.name):
        before = sum(structure.size for _, structure in files)
        told = None if progress is None else _shifted(progress, before, total)
        try:
            with path.open("rb") as stream:
                structure = FormatCheck(stream, told)
                session.read(str(path), structure)
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror}") from None
        files.append((str(path), structure))
    findings = [_built(check, files) for check in _BUILT]
    if session.ours:
        findings += [
            CheckFinding(
                check, not tally.wrong, text, [ProblemPlace(*place) for place in tally.places], tally.wrong
            )
            for check, text, tally in session.judged()
        ]
    return LogCheckResult(findings, session.ours)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None


def _shifted(progress: Progress, before: int, total: int) -> Progress:
    return lambda done, _: progress(before + done, total)


_BUILT = {"whole": "whole", "crc": "checksums", "records": "records", "index": "index"}
"""Checks of how a file is built, as `Structure` calls them and as people do."""


def _built(check: str, files: Sequence[tuple[str, FormatCheck]]) -> CheckFinding:
    """Returns how a check of how the files are built came out."""
    places = [
        ProblemPlace(name, problem.offset, problem.text)
        for name, structure in files
        for problem in structure.problems
        if problem.check == check
    ]
    wrong = sum(structure.wrong[check] for _, structure in files)
    text = _wrong_text(places, wrong) if wrong else _right_text(check, [structure for _, structure in files])
    return CheckFinding(_BUILT[check], not wrong, text, places[:MAX_LISTED_PROBLEMS], wrong)


def _wrong_text(places: Sequence[ProblemPlace], wrong: int) -> str:
    more = f"; and {wrong - 1} more" if wrong > 1 else ""
    return f"{places[0]}{more}" if places else f"{wrong} problems"


def _right_text(check: str, structures: Sequence[FormatCheck]) -> str:
    size = sum(structure.size for structure in structures)
    chunks = sum(structure.chunks for structure in structures)
    messages = sum(structure.messages.total() for structure in structures)
    return {
        "whole": f"finished, {size / 1e6:.1f} MB",
        "crc": f"{sum(structure.crcs for structure in structures)} compared, all agree",
        "records": f"{messages} messages in {chunks} chunks, built as the format says",
        "index": "is what is there",
    }[check]
