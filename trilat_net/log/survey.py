"""What is in an MCAP file besides messages, wherever it stands: to be known before they are copied.

Law: of two that say what a number means, the one that a checksum vouches for is believed; else the first.
"""

import os
import struct
import zlib
from typing import BinaryIO

from mcap.opcode import Opcode

from .framing import FOOTER_BYTES, HEAD, MAGIC, Frame, Framing, parsed
from .packed import Unreadable

MOST_SUMMARY_BYTES = 256 << 20
"""A longer end of a file is not checked: of an hour's log it has 7 MB."""
_FOOTER = struct.Struct("<QQI")
_CRC_BYTES = 4
_LOOKED_AT = (Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.STATISTICS)


def opcode_at(stream: BinaryIO, offset: int) -> int:
    """Returns the kind of the record that begins at an offset; 0 where there is none."""
    stream.seek(offset)
    return int.from_bytes(stream.read(1), "little")


class Survey:
    """What is in a file besides messages, wherever it stands.

    Args:
        stream: the file.

    Attributes:
        profile: the MCAP profile.
        library: what made it.
        definitions: schemas and channels outside of chunks, opcode and content.
        metadata: the last of each name.
        attachments: the first of each name.
        count: how many messages the file says that it has; None where nothing vouches for it.
        why_empty: what is wrong where there is nothing to save; else "".
    """

    def __init__(self, stream: BinaryIO) -> None:
        self.profile = self.library = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.count: int | None = None
        stream.seek(0)
        framing = Framing(stream)
        summary_at = self._summary(framing, stream)
        self._said: int | None = None
        said: list[tuple[int, bytes]] = []
        vouched: list[tuple[int, bytes]] = []
        content = False
        for frame in framing.frames():
            content |= frame.opcode in (Opcode.CHUNK, Opcode.MESSAGE)
            if frame.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                entry = frame.opcode, framing.content(frame)
                (vouched if summary_at is not None and frame.offset >= summary_at else said).append(entry)
            elif frame.opcode in _LOOKED_AT:
                self._take(framing, frame)
        self.definitions = [
            entry
            for kind in (Opcode.SCHEMA, Opcode.CHANNEL)
            for entry in ([e for e in vouched if e[0] == kind] or [e for e in said if e[0] == kind])
        ]
        if summary_at is not None:
            self.count = self._said
        content |= framing.torn is not None and opcode_at(stream, framing.torn.offset) == Opcode.CHUNK
        self.why_empty = ""
        if not (content or self.metadata or self.attachments):
            self.why_empty = "it holds no messages"
            if not framing.begins:
                self.why_empty = "it does not begin as an MCAP file does" if framing.size else "it is empty"

    def _summary(self, framing: Framing, stream: BinaryIO) -> int | None:
        """Returns where the end of a file begins that repeats what is in it, if its checksum is right."""
        if not framing.ends:
            return None
        stream.seek(-FOOTER_BYTES + HEAD, os.SEEK_END)
        begin, _, crc = _FOOTER.unpack(stream.read(_FOOTER.size))
        end = framing.size - FOOTER_BYTES
        if not crc or not 0 < begin <= end or end - begin > MOST_SUMMARY_BYTES:
            return None
        stream.seek(begin)
        content = stream.read(framing.size - begin - len(MAGIC) - _CRC_BYTES)
        return begin if zlib.crc32(content) == crc else None

    def _take(self, framing: Framing, frame: Frame) -> None:
        try:
            entry = parsed(frame.opcode, framing.content(frame))
        except Unreadable:
            return
        if frame.opcode == Opcode.HEADER:
            self.profile, self.library = entry.profile, entry.library
        elif frame.opcode == Opcode.METADATA:
            self.metadata[entry.name] = entry.metadata
        elif frame.opcode == Opcode.STATISTICS:
            self._said = entry.message_count
        else:
            self.attachments.setdefault(entry.name, entry.data)
