"""Logs whose messages are distributed over several files, each of which opens by itself."""

import io
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tests.log.builders import make_log_bytes, open_bytes
from trilat_net.log.accounting import Account
from trilat_net.log.log_writer import LogParts, LogStorage, LogWriter
from trilat_net.log.mcap_reader import McapReader
from trilat_net.log.provenance import collect_provenance


class Message(NamedTuple):
    topic: str
    payload: bytes
    log_ns: int
    publish_ns: int
    sequence: int


def read_messages(data: bytes) -> list[Message]:
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    return [
        Message(channel.topic, m.data, m.log_time, m.publish_time, m.sequence)
        for _, channel, m in reader.iter_messages(log_time_order=False)
    ]


def change_message(message: Message, **fields: object) -> Message:
    return message._replace(
        payload=msgpack.packb({**msgpack.unpackb(message.payload), **fields})
    )


def make_foreign_bytes(payloads: Sequence[bytes] = (b"{}",), **options: Any) -> bytes:
    """Returns a file of another program, with the given messages on one channel."""
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start()
    channel = writer.register_channel(
        "/t", "json", writer.register_schema("s", "jsonschema", b"{}")
    )
    for n, payload in enumerate(payloads):
        writer.add_message(channel, n, payload, n, n)
    writer.finish()
    return stream.getvalue()


def make_bytes_of_messages(
    data: bytes,
    chosen: Sequence[Message],
    *,
    finished: bool = True,
    session: dict[str, str] | None = None,
    scenario: str | None = None,
    part: int = 0,
    accounts: dict[str, str] | None = None,
    compression: CompressionType = CompressionType.ZSTD,
) -> bytes:
    """A log with the head of another one and these messages.

    Args:
        data: the other one.
        chosen: the messages.
        finished: whether it has its end.
        session: entries of the session's metadata that are changed.
        scenario: its scenario, where that is another one.
        part: its number among the parts of a log; 0: it says nothing of parts.
        accounts: its accounts.
        compression: the compression of its chunks.
    """
    reader = make_reader(io.BytesIO(data))
    stream = io.BytesIO()
    writer = Writer(stream, compression=compression)
    writer.start()
    (head,) = (
        entry.metadata for entry in reader.iter_metadata() if entry.name == "trilat.session"
    )
    head.pop("digest_chain", None)
    writer.add_metadata("trilat.session", {**head, **(session or {})})
    if part:
        writer.add_metadata("trilat.part", {"index": str(part), "previous": ""})
    (attachment,) = reader.iter_attachments()
    text = attachment.data if scenario is None else scenario.encode()
    writer.add_attachment(0, 0, attachment.name, attachment.media_type, text)
    schema = writer.register_schema("any", "jsonschema", b"{}")
    channels: dict[str, int] = {}
    for topic, payload, log_ns, publish_ns, sequence in chosen:
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "msgpack", schema)
        writer.add_message(channels[topic], log_ns, payload, publish_ns, sequence)
    if not finished:
        writer.flush()
        return stream.getvalue()
    writer.add_metadata("trilat.accounts", accounts or {})
    writer.finish()
    return stream.getvalue()


def make_parts(data: bytes, hands: Sequence[Collection[int]], **kwargs: object) -> list[bytes]:
    """Returns the parts of a log: file n has the messages whose indices are in `hands[n]`, in their order."""
    messages = read_messages(data)
    return [
        make_bytes_of_messages(
            data, [messages[index] for index in sorted(hand)], part=n + 1, **kwargs
        )  # type: ignore[arg-type]
        for n, hand in enumerate(hands)
    ]


def write_late_parts(folder: Path, *, refilled: range) -> list[Path]:
    """Writes a log in three parts, in which some records of `s` were requested later from the site's memory."""
    data = make_log_bytes("paper")
    scenario = open_bytes(data).scenario
    items = [item for item in McapReader(io.BytesIO(data), "log").messages() if item.topic]
    kept_back = [
        i for i in items if i.topic == "/trilat/paper/s/state" and i.sequence in refilled
    ]
    items = [item for item in items if item not in kept_back]
    items[len(items) * 3 // 4 : len(items) * 3 // 4] = kept_back
    accounts = {item.topic: Account() for item in items}

    def describe_accounts() -> dict[str, str]:
        return {topic: account.describe() for topic, account in accounts.items()}

    place = LogStorage(folder / "run.mcap", split_ns=40_000_000)
    now_ns = 0
    with LogParts(
        place,
        lambda stream, part: LogWriter(
            stream, scenario, "paper", "virtual", 0, collect_provenance(), part=part
        ),
    ) as log:
        log.current_accounts = describe_accounts
        for item in items:
            now_ns = max(now_ns, item.log_time_ns)
            number = item.sequence // 100 if item.topic.endswith("/link") else item.sequence
            accounts[item.topic].receive(number)
            log.add(item.topic[1:], item.payload, item.publish_time_ns, now_ns, item.sequence)
        log.finish(describe_accounts())
    return sorted(folder.glob("run-*.mcap"))
