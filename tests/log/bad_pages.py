"""Files whose pages a disk lost, did not update, or wrote elsewhere, and their recovery."""

import io
import random
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tests.log.builders import make_log_bytes
from tests.log.split_logs import Message, read_messages
from trilat_net.errors import LogError, NothingSaved
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log
from trilat_net.log.recovery import recover
from trilat_net.log.torn_chunk import PAGE_BYTES

GOLDEN = Path(__file__).parents[1] / "golden"
DAMAGES = ("none", "zeroed", "stale", "misdirected", "random")


def rewrite_as_other_program(data: bytes, chunk_bytes: int, **options: object) -> bytes:
    """Returns a log as another program writes it: definitions in the first chunk, and no digest chain."""
    reader = make_reader(io.BytesIO(data))
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=chunk_bytes, **options)  # type: ignore[arg-type]
    writer.start()
    metadata = {entry.name: dict(entry.metadata) for entry in reader.iter_metadata()}
    metadata.pop("trilat.chain", None)
    session = metadata.pop("trilat.session")
    session.pop("digest_chain", None)
    writer.add_metadata("trilat.session", session)
    for attachment in reader.iter_attachments():
        writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        assert schema is not None
        if schema.name not in schemas:
            schemas[schema.name] = writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        if channel.topic not in channels:
            channels[channel.topic] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[schema.name], channel.metadata
            )
        number = channels[channel.topic]
        writer.add_message(
            number, message.log_time, message.data, message.publish_time, message.sequence
        )
    for name, entries in metadata.items():
        writer.add_metadata(name, entries)
    writer.finish()
    return stream.getvalue()


def make_log_collection() -> dict[str, bytes]:
    """Returns whole logs of every kind of writer, by name: live, virtual, and of other programs."""
    long = make_log_bytes("paper", {"duration_s": 1.5})
    live = (GOLDEN / "live-paper.mcap").read_bytes()
    return {
        "short": make_log_bytes("paper"),
        "long": long,
        "another run": make_log_bytes("paper", {"duration_s": 1.5, "seed": 5}),
        "live": live,
        "live elsewhere": (GOLDEN / "live-4g.mcap").read_bytes(),
        "unpacked": rewrite_as_other_program(long, 50_000, compression=CompressionType.NONE),
        "lz4": rewrite_as_other_program(long, 400_000, compression=CompressionType.LZ4),
        "zstd": rewrite_as_other_program(live, 400_000),
        "without checksums": rewrite_as_other_program(live, 50_000, enable_crcs=False),
        "without chunks": rewrite_as_other_program(
            make_log_bytes("paper"), 0, use_chunking=False
        ),
    }


@dataclass(frozen=True)
class DamagedFile:
    """A damaged file: which log it was, its bytes, whether its end was cut off, and the damaged pages."""

    name: str
    data: bytes
    is_cut: bool
    pages: tuple[tuple[str, int], ...]


def draw_damaged_file(
    files: Mapping[str, bytes], names: Sequence[str], draw: random.Random
) -> DamagedFile:
    """Draws one of some logs with up to two bad pages, which in six of ten cases is cut off anywhere."""
    name = draw.choice(names)
    whole = files[name]
    data = bytearray(whole)
    is_cut = draw.random() < 0.6
    if is_cut:
        del data[draw.randrange(PAGE_BYTES, len(whole)) :]
    pages = []
    for _ in range(draw.choice([1, 1, 1, 2])):
        kind = draw.choice(DAMAGES)
        page = draw.randrange(-(-len(data) // PAGE_BYTES))
        pages.append((kind, page))
        offset = page * PAGE_BYTES
        length = len(data[offset : offset + PAGE_BYTES])
        content = bytes(data[offset : offset + PAGE_BYTES])
        if kind == "zeroed":
            content = bytes(length)
        elif kind == "stale":
            older = files[draw.choice([other for other in names if other != name])]
            content = (older * (offset // len(older) + 2))[offset : offset + length]
        elif kind == "misdirected":
            place = draw.randrange(max(1, len(whole) // PAGE_BYTES)) * PAGE_BYTES
            content = whole[place : place + length].ljust(length, b"\0")
        elif kind == "random":
            content = draw.randbytes(length)
        data[offset : offset + length] = content
    return DamagedFile(name, bytes(data), is_cut, tuple(pages))


@dataclass
class RecoveryTally:
    """What became of damaged files.

    Attributes:
        outcomes: files by outcome.
        invented: files with messages that the undamaged file does not have.
        silent: files that do not pass `verify` although recovery names nothing that is missing.
        closed: files that no command opens although recovery does not say so.
        false: files with records that are not what their inputs give.
    """

    outcomes: Counter[str]
    invented: list[DamagedFile]
    silent: list[DamagedFile]
    closed: list[DamagedFile]
    false: list[DamagedFile]

    @property
    def faultless(self) -> bool:
        """True if recovery did nothing wrong with any file."""
        return not (self.invented or self.silent or self.closed or self.false)


def recovered_all(
    files: Mapping[str, bytes],
    cases: Sequence[DamagedFile],
    folder: Path,
    *,
    verified: bool = True,
) -> RecoveryTally:
    """Recovers damaged files, and compares their messages with those of the undamaged files."""
    truth = {name: Counter(read_messages(data)) for name, data in files.items()}
    tally = RecoveryTally(Counter(), [], [], [], [])
    for case in cases:
        outcome = _judge_recovery(case, truth[case.name], folder, tally, verified)
        tally.outcomes[outcome] += 1
    return tally


def _judge_recovery(
    case: DamagedFile,
    truth: Counter[Message],
    folder: Path,
    tally: RecoveryTally,
    verified: bool,
) -> str:
    source = folder / "damaged.mcap"
    output = folder / "recovered.mcap"
    source.write_bytes(case.data)
    try:
        result = recover(source, output, force=True)
    except NothingSaved:
        return "nothing to save"
    if Counter(read_messages(output.read_bytes())) - truth:
        tally.invented.append(case)
    try:
        log = open_log(output)
    except LogError:
        if not any("commands of trilat-net do not" in text for text in result.lost):
            tally.closed.append(case)
        return "its session or scenario is lost"
    if not verified:
        return "opens"
    verdict = verify_log(log)
    if verdict.first is not None:
        tally.false.append(case)
    is_stated = bool(result.lost or result.missing)
    if not verdict.passed and not is_stated:
        tally.silent.append(case)
    return "verifies" if verdict.passed else "opens and states what is missing"
