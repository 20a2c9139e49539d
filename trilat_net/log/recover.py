"""Makes a whole file of one that is torn or damaged.

Law: what can be read is kept, byte for byte: messages with their times and numbers, metadata, attachments.
What cannot is left out and told, never made up. The file that it comes from is not touched. Any MCAP file
will do; of a log of ours the accounts are made afresh.
"""

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap.opcode import Opcode

from ..errors import LogError, NothingSaved, UsageError
from .books import Books, NotOurs
from .chunks import Progress
from .container import Container
from .copying import Copying, records_in
from .framing import HEAD, Damage, Frame, Framing, parsed
from .logfile import LogFile
from .names import ACTIVE, unfinished
from .packed import Unreadable, unpacked
from .provenance import provenance
from .salvage import READ_BYTES, salvaged
from .survey import Survey, opcode_at
from .writer import ACCOUNTS

RECOVERED = "trilat.recovered"
"""Metadata that says what a file was made from, and what was lost."""
MOST_LOSSES = 20
"""Losses that are told one by one."""
_MADE_AGAIN = frozenset(
    {Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.STATISTICS}
    | {Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET, Opcode.DATA_END, Opcode.FOOTER}
)
"""What a whole file has besides its content: nothing is lost with it."""
_CRC = struct.Struct("<I")
_INDEX = struct.Struct("<HI")


@dataclass
class Recovery:
    """What came of it.

    Attributes:
        path: the file that it comes from.
        output: the file that was made.
        finished: whether the file had been finished.
        messages: how many it has.
        sites: per site how many records; empty where it is no log of ours.
        duration_s: from the first message to the last, by the times at which they were logged, s.
        chunks: how many chunks were whole.
        salvaged: messages out of a last chunk that was cut off.
        lost: what was lost, a sentence each.
        lost_bytes: how many bytes could not be read.
        missing: per site which records are not in the file, be they lost here or never recorded.
    """

    path: Path
    output: Path
    finished: bool = False
    messages: int = 0
    sites: dict[str, int] = field(default_factory=dict)
    duration_s: float = 0.0
    chunks: int = 0
    salvaged: int = 0
    lost: list[str] = field(default_factory=list)
    lost_bytes: int = 0
    missing: list[str] = field(default_factory=list)

    @property
    def lossless(self) -> bool:
        """Whether all that was in the file is in the new one."""
        return not self.lost

    def facts(self) -> dict[str, str]:
        """Returns what the new file says of it."""
        told = self.lost[:MOST_LOSSES]
        more = [f"and {len(self.lost) - len(told)} more"] if len(self.lost) > len(told) else []
        return {
            "from": self.path.name,
            "finished": str(self.finished).lower(),
            "lost": "; ".join(told + more) or "nothing",
            "lost_bytes": str(self.lost_bytes),
            "salvaged_messages": str(self.salvaged),
            "missing": "; ".join(self.missing) or "nothing",
        }


def recovered_path(path: Path) -> Path:
    """Returns the name of the file that is made of another one by default."""
    if path.name.endswith(ACTIVE) and path.name != ACTIVE:
        return path.with_name(path.name.removesuffix(ACTIVE))
    return path.with_name(f"{path.stem}.recovered{path.suffix or '.mcap'}")


def recover(
    path: Path, output: Path | None = None, *, force: bool = False, progress: Progress | None = None
) -> Recovery:
    """Makes a whole file of one that is torn or damaged.

    Args:
        path: the file.
        output: the file to be made; by default `recovered_path`.
        force: whether it may replace one.
        progress: told how many bytes are read, and how many there are.

    Raises:
        LogError: the file cannot be read.
        NothingSaved: there is nothing in it that could be kept.
        UsageError: the output exists, or cannot be made.
        LogRefused: the disk refused; nothing was made.
    """
    made = output or recovered_path(path)
    if made.exists() and path.exists() and made.samefile(path):
        raise UsageError(f"{made}: is the file itself, which is not touched; choose another name with -o")
    try:
        with path.open("rb") as stream:
            return _recover(stream, Recovery(path, made), force, progress)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}{unfinished(path)}") from None


def _recover(stream: BinaryIO, result: Recovery, force: bool, progress: Progress | None) -> Recovery:
    survey = Survey(stream)
    if survey.why_empty:
        raise NothingSaved(f"{result.path}: there is nothing in it that could be saved: {survey.why_empty}")
    working = result.output.with_name(result.output.name + ".recovering")
    working.unlink(missing_ok=True)
    file = LogFile(result.output, force=force, working=working)
    try:
        _Passage(stream, file, survey, result).run(progress)
        file.close()
    except BaseException:
        file.discard()
        if file.trouble is not None:
            raise file.refused(file.trouble) from None
        raise
    return result


class _Passage:
    """The way of one file into another."""

    def __init__(self, stream: BinaryIO, file: LogFile, survey: Survey, result: Recovery) -> None:
        self._stream, self._result, self._survey = stream, result, survey
        stream.seek(0)
        self._framing = Framing(stream)
        by = f"recovered by trilat-net {provenance()['version_trilat-net']}"
        self._out = Container(file, f"{survey.library or 'unknown'}, {by}", survey.profile)
        try:
            self._books: Books | None = Books(survey.metadata, survey.attachments)
        except NotOurs:
            self._books = None
        self._copying = Copying(self._out, self._opened, self._took)
        self._data_end = self._framing.size + 1
        for opcode, content in survey.definitions:
            try:
                self._copying.define(opcode, content)
            except Unreadable as error:
                self._lose(f"a definition: {error}", len(content))

    def _opened(self, topic: str) -> None:
        if self._books is not None:
            self._books.open(topic)

    def _took(self, topic: str, sequence: int, payload: bytes) -> None:
        if self._books is not None:
            self._books.take(topic, sequence, payload)

    def _lose(self, what: str, size: int) -> None:
        self._result.lost.append(what)
        self._result.lost_bytes += size

    def run(self, progress: Progress | None) -> None:
        """Copies all that can be read, and writes what is to be said of it."""
        framing = self._framing
        self._copying.open_all()
        told = 0
        for frame in framing.frames():
            told = self._tell_damaged(told)
            try:
                self._take(frame)
            except Unreadable as error:
                self._lose(
                    f"{HEAD + frame.length} bytes at byte {frame.offset}: {error}", HEAD + frame.length
                )
            if progress is not None:
                progress(frame.end, framing.size)
        self._tell_damaged(told)
        if framing.torn is not None:
            self._end(framing.torn)
        self._conclude()

    def _tell_damaged(self, told: int) -> int:
        for damage in self._framing.damaged[told:]:
            if damage.offset <= self._data_end:
                self._lose(f"{damage}", damage.length)
        return len(self._framing.damaged)

    def _take(self, frame: Frame) -> None:
        """Copies one record of the file."""
        opcode = frame.opcode
        if opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL):
            return
        content = self._framing.content(frame)
        if opcode in _MADE_AGAIN:
            self._pass_over(frame, content)
            return
        if opcode == Opcode.CHUNK:
            for entry in records_in(unpacked(content)):
                self._copying.take(*entry)
            self._result.chunks += 1
        elif opcode == Opcode.MESSAGE:
            self._copying.take(opcode, content)
        elif opcode == Opcode.METADATA:
            self._take_metadata(parsed(opcode, content))
        elif opcode == Opcode.ATTACHMENT:
            self._take_attachment(parsed(opcode, content), content)
        else:
            raise Unreadable(f"nobody here knows a record of kind {opcode}")

    def _pass_over(self, frame: Frame, content: bytes) -> None:
        """Leaves out what is made again, if it is that and not something else whose kind was damaged."""
        if frame.opcode == Opcode.DATA_END and len(content) == _CRC.size:
            self._data_end = frame.offset
        elif frame.opcode == Opcode.MESSAGE_INDEX:
            size = _INDEX.unpack_from(content)[1] if len(content) >= _INDEX.size else -1
            if size != len(content) - _INDEX.size or size % 16:
                raise Unreadable("a record (message index) is none")
        elif frame.offset < self._data_end:
            raise Unreadable(f"a record of kind {frame.opcode} stands among the data")

    def _take_metadata(self, entry: Any) -> None:
        if entry.name != RECOVERED and (entry.name != ACCOUNTS or self._books is None):
            self._out.add_metadata(entry.name, entry.metadata)

    def _take_attachment(self, entry: Any, content: bytes) -> None:
        crc = _CRC.unpack(content[-_CRC.size :])[0]
        if crc and zlib.crc32(content[: -_CRC.size]) != crc:
            self._lose(f"attachment {entry.name}: its CRC differs; it is kept as it is", 0)
        self._out.add_attachment(entry.create_time, entry.log_time, entry.name, entry.media_type, entry.data)

    def _end(self, torn: Damage) -> None:
        """Sees to the end that was cut off."""
        opcode = opcode_at(self._stream, torn.offset)
        if not torn.length or opcode in _MADE_AGAIN or torn.offset > self._data_end:
            return
        if opcode != Opcode.CHUNK:
            self._lose(f"{torn}", torn.length)
            return
        self._stream.seek(torn.offset + HEAD)
        before = self._out.messages
        try:
            for entry in salvaged(self._stream.read(READ_BYTES)):
                self._copying.take(*entry)
        except Unreadable:
            pass  # what follows makes no sense, and is lost with the rest
        self._result.salvaged = self._out.messages - before
        self._lose(
            f"the end of a chunk that was cut off at byte {torn.offset}; of its {torn.length} bytes "
            f"{self._result.salvaged} messages could be saved",
            torn.length,
        )

    def _conclude(self) -> None:
        """Writes the accounts, what was lost, and the index."""
        result, copying = self._result, self._copying
        self._out.flush()
        for number, count in copying.lost.items():
            self._lose(f"{count} messages of channel {number}, which nobody names", 0)
        for topic in copying.bare:
            self._lose(f"the schema of {topic}", 0)
        for number in copying.contradicted:
            self._lose(f"what channel or schema {number} is: the file says it in two ways", 0)
        expected = self._survey.count
        if expected is not None and self._out.messages < expected and result.lossless:
            self._lose(f"{expected - self._out.messages} of the {expected} messages that it says it has", 0)
        result.finished = self._framing.finished
        result.messages = self._out.messages
        result.duration_s = self._out.duration_s
        if self._books is not None:
            result.missing = list(self._books.missing())
            result.sites = self._books.records()
            before = self._survey.metadata.get(ACCOUNTS, {})
            counts = {name: text for name, text in before.items() if not name.startswith("/")}
            self._out.add_metadata(ACCOUNTS, {**self._books.texts(), **counts})
        self._out.add_metadata(RECOVERED, result.facts())
        self._out.finish()
