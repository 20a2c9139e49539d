"""Writes a session into one MCAP file: live by the recorder, in virtual time by the simulation.

Law (L5): the file explains itself, from its first bytes on: session, scenario and schemas stand before the
first message, payloads are byte for byte what was published, and the accounts stand at the end.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
from mcap.writer import CompressionType, Writer

from ..errors import LogRefused, UsageError
from ..net import topics
from ..net.messages import VERSION, Event, LinkStats, State, json_schema
from ..scenario import Scenario
from .accounting import Account
from .provenance import provenance

SESSION, ACCOUNTS, SCENARIO = "trilat.session", "trilat.accounts", "scenario.toml"
SCHEMAS: dict[str, type[msgspec.Struct]] = {topics.STATE: State, topics.LINK: LinkStats, topics.EVENT: Event}

_CHUNK_BYTES = 1 << 20
_LAST_NS = (1 << 64) - 1  # of the file's time stamps; a stranger's may be anything


@contextmanager
def new_file(path: Path, *, force: bool = False) -> Iterator[BinaryIO]:
    """Opens a file for writing that must not exist yet, unless it may be replaced; closes it at the end.

    Args:
        path: which file.
        force: whether it may replace one.

    Raises:
        UsageError: it exists, or cannot be made.
        LogRefused: the disk refused what was still to be written.
    """
    try:
        stream = path.open("wb" if force else "xb")
    except FileExistsError:
        raise UsageError(f"{path}: exists; choose another name, or replace it with --force") from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        yield stream
    finally:
        try:
            stream.close()
        except OSError as error:  # what a full disk refused is refused once more on closing
            raise _refused(error) from None


class LogWriter:
    """One log, from its header to its last account.

    Args:
        stream: where the bytes go, opened for writing.
        scenario: the resolved scenario.
        session: the session's name.
        driver: "live" or "virtual".
        epoch_unix_ns: Unix time of tick 0; 0 in virtual time.
        facts: what else to say of the session.

    Attributes:
        accounts: per site the account of its records.
    """

    def __init__(
        self,
        stream: BinaryIO,
        scenario: Scenario,
        session: str,
        driver: str,
        epoch_unix_ns: int,
        facts: Mapping[str, str] | None = None,
    ) -> None:
        self.accounts = {site: Account() for site in scenario.names}
        self._epoch_unix_ns = epoch_unix_ns
        self._stream = stream
        self._writer: Any = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=f"trilat-net {provenance()['version_trilat-net']}")
        self._writer.add_metadata(
            SESSION,
            {
                "schema_version": str(VERSION),
                "session": session,
                "driver": driver,
                "scenario": scenario.name,
                "scenario_sha256": scenario.sha256,
                "seed": str(scenario.seed),
                "sites": " ".join(scenario.names),
                "epoch_unix_ns": str(epoch_unix_ns),
                **provenance(),
                **(facts or {}),
            },
        )
        self._writer.add_attachment(0, 0, SCENARIO, "application/toml", scenario.text.encode())
        self._channels = self._register(scenario, session)
        self._session = session
        self._written = dict.fromkeys(self._channels, 0)
        stream.flush()

    def _register(self, scenario: Scenario, session: str) -> dict[str, int]:
        schemas = {
            name: self._writer.register_schema(
                f"trilat.{kind.__name__}.v{VERSION}", "jsonschema", json.dumps(json_schema(kind)).encode()
            )
            for name, kind in SCHEMAS.items()
        }
        channels = {}
        for member in (*scenario.names, topics.RECORDER):
            for name in SCHEMAS if member != topics.RECORDER else (topics.EVENT,):
                key = topics.key(session, member, name)
                rate = {"rate_hz": str(scenario.sites[member].rate_hz)} if name == topics.STATE else {}
                channels[key] = self._writer.register_channel(
                    f"/{key}", "msgpack", schemas[name], {"member": member, **rate}
                )
        return channels

    def knows(self, key: str) -> bool:
        """True where messages of this key have a channel in the file."""
        return key in self._channels

    def add(self, key: str, payload: bytes, t_ns: int, log_time_ns: int, tick: int) -> None:
        """Writes one message that is no record of a tick.

        Args:
            key: its key, one that `knows` knows.
            payload: its bytes.
            t_ns: its nominal time, ns since the epoch.
            log_time_ns: when it arrived, Unix ns.
            tick: its sequence number.

        Raises:
            LogRefused: the disk refused.
        """
        try:
            self._writer.add_message(
                channel_id=self._channels[key],
                log_time=log_time_ns,
                data=payload,
                publish_time=min(max(0, self._epoch_unix_ns + t_ns), _LAST_NS),
                sequence=max(0, tick) & 0xFFFFFFFF,
            )
        except OSError as error:
            raise _refused(error) from None
        self._written[key] += 1

    def add_state(self, site: str, key: str, payload: bytes, t_ns: int, log_time_ns: int, tick: int) -> bool:
        """Writes the record of one tick and books it; False, and nothing written, where it is a duplicate."""
        if not self.accounts[site].take(tick):
            return False
        self.add(key, payload, t_ns, log_time_ns, tick)
        return True

    def flush(self) -> None:
        """Closes the open chunk and hands it to the operating system: a crash loses nothing before it."""
        try:
            self._writer.flush()
            self._stream.flush()
        except OSError as error:
            raise _refused(error) from None

    def finish(
        self,
        ticks: Mapping[str, int],
        overflowed: Mapping[str, int] | None = None,
        counts: Mapping[str, str] | None = None,
    ) -> None:
        """Writes the accounts of every channel, the index and the end mark. The stream stays open.

        Args:
            ticks: per site, how many ticks it said that it made.
            overflowed: per key, messages that were lost before they could be written.
            counts: what else was counted, by name.
        """
        lost = dict(overflowed or {})
        for site, count in ticks.items():
            self.accounts[site].expect(count)
        texts = {key: f"received {count}" for key, count in self._written.items()}
        for site, account in self.accounts.items():
            texts[topics.key(self._session, site, topics.STATE)] = account.as_text()
        accounts = {f"/{key}": f"{text}, overflowed {lost.pop(key, 0)}" for key, text in texts.items()}
        others = {"overflowed elsewhere": str(sum(lost.values()))} if lost else {}
        try:
            self._writer.add_metadata(ACCOUNTS, {**accounts, **others, **(counts or {})})
            self._writer.finish()
            self._stream.flush()
        except OSError as error:
            raise _refused(error) from None


def _refused(error: OSError) -> LogRefused:
    return LogRefused(f"the log cannot be written: {error.strerror}; what was flushed before is intact")
