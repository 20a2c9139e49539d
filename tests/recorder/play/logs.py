"""The content of a log, read by an independent reader, and logs of events at prescribed times."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from trilat_net.app.play.batch import MessageBatch
from trilat_net.app.play.session_reader import PlaySelection, SessionHeader, SessionReader
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.net import topics
from trilat_net.net.messages import Event
from trilat_net.net.wire import encode
from trilat_net.scenario import load_scenario

BOOT = 7
EPOCH_UNIX_NS = 1_700_000_000_000_000_000


def read_payloads(path: Path) -> dict[str, list[bytes]]:
    """Returns every payload of a finished file by topic, in file order, read by the `mcap` package."""
    payloads_by_topic: dict[str, list[bytes]] = {}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            payloads_by_topic.setdefault(channel.topic, []).append(message.data)
    return payloads_by_topic


def read_session_payloads(path: Path) -> dict[str, list[bytes]]:
    """Returns the same for the messages of sites: by member and channel, as in "m1/state"."""
    return {
        "/".join(topic.split("/")[3:]): payload_list
        for topic, payload_list in read_payloads(path).items()
        if topic.startswith("/trilat/") and "/recorder/" not in topic
    }


def encode_event(site: str, n: int) -> bytes:
    return encode(Event(member=site, boot=BOOT, kind="mode", text=f"{site} {n}", n=n))


def write_event_log(
    path: Path, messages: Iterable[tuple[str, int, int, int]], session: str = "paper"
) -> Path:
    """Writes a log of events.

    Args:
        path: where.
        messages: (site, number, when it was sent, when it came; ms since the epoch), in file order.
        session: its name.
    """
    with path.open("wb") as stream:
        writer = LogWriter(
            stream, load_scenario("paper"), session, "live", EPOCH_UNIX_NS, collect_provenance()
        )
        for site, n, sent_ms, came_ms in messages:
            key = topics.key(session, site, topics.EVENT)
            came_ns = EPOCH_UNIX_NS + came_ms * 1_000_000
            writer.add(key, encode_event(site, n), sent_ms * 1_000_000, came_ns, n)
        writer.finish({})
    return path


def preload_paths(*paths: Path, **selection: Any) -> tuple[SessionHeader, MessageBatch]:
    header, batch = SessionReader(paths, PlaySelection(**selection)).preload(1 << 28)
    assert batch is not None
    return header, batch
