"""Writes a rerun as a log: executed sites anew, recorded sites byte for byte.

Invariant: the file names its source log by SHA-256, the executed sites and the changes; its scenario is the
one that holds in it. An executed site has no measured values (timing, round trips).
"""

import hashlib
from collections.abc import Iterator, Sequence
from heapq import merge
from pathlib import Path
from typing import NamedTuple

import msgspec

from ..core.ticks import Arrival, Mode, describe_divergence, describe_mode
from ..errors import LogError
from ..log.accounting import Account
from ..log.log_layout import SITE_CHANNELS
from ..log.log_reader import Log
from ..log.log_writer import LogWriter
from ..log.mcap_writer import Sink
from ..net import topics
from ..net.loop_stats import ticks_per_stats
from ..net.messages import READABLE, VERSION, Event, LinkStats, State
from ..net.wire import decode, encode, encode_state
from .rerun_execution import RerunTick
from .rerun_request import RerunRequest, describe_rerun_changes
from .resumption import read_output
from .verify import EXECUTED_SITES_KEY

RERUN_DRIVER = "rerun"
_LAST_NS = (1 << 64) - 1  # of the file's time stamps; a stranger's may be anything
SENT_TIME_SINCE = 2
"""First schema version whose records say when they were sent."""


class _Entry(NamedTuple):
    """One message of the file.

    Attributes:
        t_ns: when it is of, ns since the epoch; by it entries stand in order.
        sent_ns: when it was sent, on the sender's clock.
        key: its key.
        sequence: what the file calls it by.
        number: its number in its channel.
        payload: its bytes.
        message: what it says.
    """

    t_ns: int
    sent_ns: int
    key: str
    sequence: int
    number: int
    payload: bytes
    message: State | LinkStats | Event


def write_rerun_log(
    log: Log, premise: RerunRequest, made: Sequence[RerunTick], stream: Sink, views_hz: float = 0.0
) -> None:
    """Writes a rerun into a file; the stream stays open.

    Args:
        log: the log that it comes from.
        premise: what was asked of it.
        made: every tick that was made, in order.
        stream: where the bytes go.
        views_hz: messages a second of the standard channels beside the log's own, see `log.views`.

    Raises:
        LogError: the log says of its epoch what is no time.
        LogRefused: the disk refused.
    """
    session, epoch_unix_ns = log.session["session"], _epoch_unix_ns(log)
    told = rerun_metadata(log, premise)
    writer = LogWriter(
        stream, premise.scenario, session, RERUN_DRIVER, epoch_unix_ns, told, views_hz=views_hz
    )
    keys = [topics.key(session, name, channel) for name in log.sites for channel in SITE_CHANNELS]
    accounts = {key: Account() for key in keys}
    by_site: dict[str, list[RerunTick]] = {name: [] for name in premise.replaced}
    for one in made:
        by_site[one.site].append(one)
    parts = [_recorded(log, name) for name in premise.recorded]
    parts += [_executed(log, premise, name, ticks) for name, ticks in by_site.items()]
    for entry in merge(*parts, key=lambda entry: entry.t_ns):
        accounts[entry.key].take(entry.number)
        log_time_ns = min(max(0, epoch_unix_ns + entry.t_ns), _LAST_NS)
        writer.add(entry.key, entry.payload, entry.sent_ns, log_time_ns, entry.sequence, entry.message)
    writer.finish({f"/{key}": f"{account.as_text()}, overflowed 0" for key, account in accounts.items()})


def _epoch_unix_ns(log: Log) -> int:
    written = log.session.get("epoch_unix_ns", "0")
    if not written.isdecimal() or int(written) > _LAST_NS:
        raise LogError(f"{log.source}: its epoch_unix_ns is no time: {written[:40]!r}")
    return int(written)


def rerun_metadata(log: Log, premise: RerunRequest) -> dict[str, str]:
    """Returns what the file says of where it comes from."""
    files = [path for path in map(Path, log.sources) if path.is_file()]  # none of a log in memory
    return {
        "rerun_mode": premise.mode,
        "rerun_of": " ".join(path.name for path in files),
        "rerun_of_sha256": " ".join(map(_sha256, files)),
        "rerun_of_driver": log.driver,
        EXECUTED_SITES_KEY: " ".join(premise.replaced),
        "rerun_changes": "; ".join(describe_rerun_changes(premise)),
    }


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _recorded(log: Log, name: str) -> Iterator[_Entry]:
    """Yields all that a site published that stands as recorded, in order of time."""
    part = log[name]
    keys = _Keys(log, name, part.rate_hz)
    said = [event for event in log.events if event.member == name]
    said.sort(key=lambda event: event.t_ns)  # what was said before the epoch first
    return merge(
        (keys.state(state, payload) for state, payload in zip(part.states, part.payloads, strict=True)),
        (keys.stats(stats) for stats in log.link_stats(name)),
        (keys.event(event, n) for n, event in enumerate(said)),
        key=lambda entry: entry.t_ns,
    )


def _executed(log: Log, premise: RerunRequest, name: str, made: Sequence[RerunTick]) -> Iterator[_Entry]:
    """Yields all that a site says that was executed, in order of time."""
    keys = _Keys(log, name, premise.scenario.sites[name].rate_hz)
    boot = log[name].states[0].boot if len(log[name]) else 0
    mode, said, t_ns, ticks = Mode.RUN, 0, 0, 0

    def say(kind: str, text: str) -> _Entry:
        event = Event(member=name, boot=boot, n=said, kind=kind, text=text, t_ns=t_ns, ticks=ticks)
        return keys.event(event, said)

    for one in made:
        t_ns, ticks = one.t_ns, one.tick + 1
        state = decode(one.payload, State, READABLE)
        yield keys.state(state, one.payload)
        if one.stats is not None:
            yield keys.stats(one.stats)
        if one.mode is not mode:
            mode = one.mode
            text = describe_divergence if mode is Mode.DIVERGED else describe_mode
            kind = "diverged" if mode is Mode.DIVERGED else "mode"
            yield say(kind, text(name, read_output(state, log[name].peers)))
            said += 1
    yield say("end", f"{name} made {ticks} ticks")


class _Keys:
    """One site's channels in the file; what an older version said is said in the present one."""

    def __init__(self, log: Log, name: str, rate_hz: int) -> None:
        session = log.session["session"]
        self._state, self._link, self._event = (
            topics.key(session, name, channel) for channel in SITE_CHANNELS
        )
        self._peers = log[name].peers
        self._every = ticks_per_stats(rate_hz)

    def state(self, state: State, payload: bytes) -> _Entry:
        """Returns the entry of a record."""
        sent_ns = state.sent_ns if state.v >= SENT_TIME_SINCE else state.t_ns
        if state.v != VERSION:
            output = read_output(state, self._peers)
            arrivals = [Arrival(peer, tick, (), (), us) for peer, tick, us in state.rx]
            late_us, busy_us = state.late_us, state.busy_us
            payload = encode_state(
                state.site, state.boot, self._peers, output, arrivals, late_us, busy_us, sent_ns, state.echo
            )
        return _Entry(state.t_ns, sent_ns, self._state, state.tick, state.tick, payload, state)

    def stats(self, stats: LinkStats) -> _Entry:
        """Returns the entry of statistics."""
        payload = encode(msgspec.structs.replace(stats, v=VERSION))
        return _Entry(
            stats.t_ns, stats.t_ns, self._link, stats.tick, stats.tick // self._every, payload, stats
        )

    def event(self, event: Event, n: int) -> _Entry:
        """Returns the entry of an event that is the n-th of its site."""
        numbered = event if event.n >= 0 else msgspec.structs.replace(event, n=n)
        payload = encode(msgspec.structs.replace(numbered, v=VERSION))
        t_ns = max(event.t_ns, 0)
        return _Entry(t_ns, t_ns, self._event, numbered.n, numbered.n, payload, numbered)
