"""Hostile logs, and everybody who reads one. Shared by the tests and by `tests/fuzz_log.py`."""

import io
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol
from unittest import mock

import lz4.frame
import msgpack
import zstandard

from tests.log.builders import edit_log_bytes
from trilat_net.analysis.file_overview import info
from trilat_net.app.play.session_reader import PlaySelection, SessionReader
from trilat_net.errors import TrilatError
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log
from trilat_net.log.mcap_records import RecordScanner, iterate_records, unpack_chunk
from trilat_net.log.recovery import recover
from trilat_net.log.session_check import check_file

LENGTHS = (
    0,
    1,
    7,
    22,
    255,
    1 << 16,
    1 << 20,
    1 << 31,
    (1 << 32) - 1,
    1 << 40,
    (1 << 63) - 1,
    (1 << 64) - 1,
)
NUMBERS = (
    0,
    -1,
    1,
    3,
    119,
    120,
    255,
    1 << 31,
    1 << 40,
    (1 << 40) - 1,
    (1 << 63) - 1,
    -(1 << 63),
    (1 << 64) - 1,
)
VALUES: tuple[Any, ...] = (
    *NUMBERS,
    float("nan"),
    float("inf"),
    1e308,
    -1e308,
    5e-324,
    "",
    "x",
    "m1",
    "diverged",
    "end",
    None,
    True,
    [],
    {},
    [0, 0],
    [0.0] * 3,
    [float("nan")] * 3,
    [1e300] * 3,
    [[0, 0, 0]] * 300,
    [[1 << 40, (1 << 40) - 1, -(1 << 58)]],
    [[0, 5, 0], [0, 5, 0], [1, (1 << 58), 3]],
    {"m2": 1 << 62, "s": (1 << 64) - 1},
    {"m2": -(1 << 63)},
    {str(n): n for n in range(300)},
    ["{}", '{"link": "m2->m1"}', "[" * 2000, '{"at_s": 1e999}'],
    ["x" * 5000],
)
"""Hostile values of a field of a message."""
TEXTS = (
    "",
    "0",
    "-1",
    "9" * 400,
    "x" * 3000,
    "\x1b[31m",
    "live",
    "virtual",
    "m1 m2 s",
    "1e999",
    "²",
)
SCENARIO_VALUES = (
    "0x" + "f" * 300,
    "-1",
    "1e308",
    "5e-324",
    "nan",
    "''",
    "[]",
    "{}",
    "[[]]",
    "true",
    "86400",
    "20000",
    "1",
    "[1e308, 1e308]",
    "'/dev/zero'",
    "'0 0, 1 lost'",
)


class Draws(Protocol):
    """A source of choices, such as `random.Random` or the bytes of a fuzzer."""

    def randrange(self, start: int, stop: int) -> int:
        """Returns a number from start to before stop."""

    def random(self) -> float:
        """Returns a number from 0 to before 1."""


def one_of(draws: Draws, values: Sequence[Any]) -> Any:
    return values[draws.randrange(0, len(values))]


def draw_other_value(value: Any, draws: Draws) -> Any:
    """Returns another value, mostly of the same kind."""
    alike = [each for each in VALUES if type(each) is type(value)]
    return one_of(draws, alike if alike and draws.random() < 0.8 else VALUES)


def flip_bits(data: bytes, draws: Draws) -> bytes:
    """Returns a copy with up to three flipped bits."""
    changed = bytearray(data)
    for _ in range(draws.randrange(1, 4)):
        changed[draws.randrange(0, len(changed))] ^= 1 << draws.randrange(0, 8)
    return bytes(changed)


def cut_bytes(data: bytes, draws: Draws) -> bytes:
    """Returns a copy without its end, or without a piece in the middle."""
    start = draws.randrange(0, len(data))
    length = len(data) if draws.random() < 0.5 else draws.randrange(1, 2000)
    return data[:start] + data[start + length :]


def replace_length(data: bytes, draws: Draws) -> bytes:
    """Returns a copy with a hostile length, offset or count at a random place."""
    changed = bytearray(data)
    size = one_of(draws, (2, 4, 8))
    at = draws.randrange(0, len(data) - size)
    changed[at : at + size] = (one_of(draws, LENGTHS) & ((1 << 8 * size) - 1)).to_bytes(
        size, "little"
    )
    return bytes(changed)


def replace_record_length(data: bytes, draws: Draws) -> bytes:
    """Returns a copy in which one record states a wrong length."""
    frames = list(RecordScanner(io.BytesIO(data)).frames())
    frame = one_of(draws, frames)
    changed = bytearray(data)
    length = one_of(draws, (*LENGTHS, frame.length + 1, max(0, frame.length - 1), len(data)))
    struct.pack_into("<Q", changed, frame.offset + 1, length)
    return bytes(changed)


def make_chunk(
    records: bytes, size: int | None = None, compression: str = "zstd", crc: int | None = None
) -> bytes:
    """Returns a chunk with the given records, whose stated size and checksum may be wrong."""
    packed = {
        "zstd": lambda: zstandard.compress(records),
        "lz4": lambda: lz4.frame.compress(records),
        "": lambda: records,
    }[compression]()
    name = compression.encode()
    head = struct.pack(
        "<QQQI",
        0,
        0,
        len(records) if size is None else size,
        zlib.crc32(records) if crc is None else crc,
    )
    content = (
        head + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed
    )
    return struct.pack("<BQ", 6, len(content)) + content


def change_chunk(data: bytes, draws: Draws, change: Callable[[bytes, Draws], bytes]) -> bytes:
    """Returns a copy in which the content of one chunk is changed, and its checksum is right."""
    framing = RecordScanner(io.BytesIO(data))
    chunks = [frame for frame in framing.frames() if frame.opcode == 6]
    if not chunks:
        return data
    frame = one_of(draws, chunks)
    try:
        inside = change(unpack_chunk(framing.content(frame)), draws)
    except Exception:  # it is damaged already
        return data
    new = make_chunk(inside, compression=one_of(draws, ("zstd", "lz4", "")))
    return data[: frame.offset] + new + data[frame.end :]


def change_inside(data: bytes, draws: Draws) -> bytes:
    """Returns a copy in which the content of one chunk is damaged."""
    return change_chunk(data, draws, one_of(draws, (flip_bits, cut_bytes, replace_length)))


def change_message(data: bytes, draws: Draws) -> bytes:
    """Returns a copy in which one message has another value in a field."""

    def change(inside: bytes, draws: Draws) -> bytes:
        records = iterate_records(inside)
        places = [(begin - 9, end - begin) for opcode, begin, end in records if opcode == 5]
        if not places:
            return inside
        for _ in range(draws.randrange(1, 4)):
            at, length = places[-1 - draws.randrange(0, len(places))]
            payload = inside[at + 31 : at + 9 + length]
            try:
                fields = msgpack.unpackb(payload)
                name = one_of(draws, list(fields))
                fields[name] = draw_other_value(fields[name], draws)
                payload = msgpack.packb(fields)
            except Exception:  # not one of ours, or what cannot be packed
                payload = flip_bits(payload, draws) if payload else payload
            new = struct.pack("<BQ", 5, 22 + len(payload)) + inside[at + 9 : at + 31] + payload
            inside = inside[:at] + new + inside[at + 9 + length :]
            break
        return inside

    return change_chunk(data, draws, change)


def change_field(data: bytes, draws: Draws) -> bytes:
    """Returns a copy in which a field has another value from some record of a site on."""
    names = "tick t_ns used rx cmd mem mode late_us boot site echo v sent_ns rx_crc busy_us q"
    name = one_of(draws, names.split())
    kinds = {
        "used": {},
        "rx": [],
        "cmd": [],
        "mem": [],
        "echo": [],
        "q": [],
        "mode": "",
        "site": "",
    }
    value = draw_other_value(kinds.get(name, 0), draws)
    since = draws.randrange(0, 30)
    site = one_of(draws, ("m1", "m2", "s"))

    def change(record: dict[str, Any]) -> dict[str, Any]:
        hit = record["site"] == site and record["tick"] >= since
        return {**record, name: value} if hit else record

    try:
        return edit_log_bytes(data, record=change)
    except Exception:  # it was no log any more
        return data


def change_session(data: bytes, draws: Draws) -> bytes:
    """Returns a copy in which one entry of the session's metadata is another text."""
    keys = "session driver scenario_sha256 epoch_unix_ns schema_version sites fingerprint seed rerun_executed"
    try:
        return edit_log_bytes(data, session={one_of(draws, keys.split()): one_of(draws, TEXTS)})
    except Exception:
        return data


def change_scenario(data: bytes, draws: Draws) -> bytes:
    """Returns a copy whose scenario has other values."""

    def change(text: str) -> str:
        lines = text.split("\n")
        places = [n for n, line in enumerate(lines) if " = " in line]
        if not places:
            return text
        for _ in range(draws.randrange(1, 3)):
            place = one_of(draws, places)
            key = lines[place].partition(" = ")[0]
            lines[place] = f"{key} = {one_of(draws, SCENARIO_VALUES)}"
        return "\n".join(lines)

    try:
        return edit_log_bytes(data, scenario=change)
    except Exception:
        return data


CHANGES: tuple[Callable[[bytes, Draws], bytes], ...] = (
    flip_bits,
    cut_bytes,
    replace_length,
    replace_record_length,
    change_inside,
    change_message,
    change_message,
    change_field,
    change_session,
    change_scenario,
)


def mangle_log(data: bytes, draws: Draws) -> bytes:
    """Returns a copy that is changed in one or two ways."""
    for _ in range(draws.randrange(1, 3)):
        if len(data) > 16:
            data = one_of(draws, CHANGES)(data, draws)
    return data


def _read_arrays(path: Path) -> None:
    log = open_log(path)
    for site in log.sites:
        part = log[site]
        _ = part.q, part.used, part.arrivals, part.t_s, part.mode, part.late_us, part.sent_ns
        log.link_stats(site)
        log.changes(site)
    repr(log)
    log.recorder_stats()
    _ = log.accounts, log.complete


def _verify(path: Path) -> None:
    verify_log(open_log(path))


def _recover(path: Path) -> None:
    output = path.with_name("made.mcap")
    output.unlink(missing_ok=True)
    with mock.patch("os.fsync"), mock.patch("os.fdatasync"):  # no disk is under test here
        recover(path, output)


READERS: dict[str, Callable[[Path], object]] = {
    "arrays": _read_arrays,
    "verify": _verify,
    "info": lambda path: info(path).facts,
    "check": lambda path: check_file(path),
    "recover": _recover,
    "replay": lambda path: SessionReader([path], PlaySelection()).preload(64 << 20),
}
"""The readers of logs, by name."""


def read_by_all(path: Path) -> dict[str, str]:
    """Returns the complaints of all readers about a file, by reader; only a `TrilatError` counts as a complaint."""
    complaints = {}
    for name, reader in READERS.items():
        try:
            reader(path)
        except TrilatError as error:
            complaints[name] = str(error)
    return complaints
