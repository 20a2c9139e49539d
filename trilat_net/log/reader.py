"""Reads a log: the scenario, the session, and every site's records as arrays with time.

    log = open_log("run.mcap")
    log["m1"].t_s, log["m1"].q

Law: a log is read as it is. Files of every released schema version open; a torn one opens as far as it is
whole, and says so (`complete`).
"""

import hashlib
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from .. import collector
from ..core.arm import Array
from ..core.grid import NS_PER_S
from ..core.tick import Command
from ..errors import LogError, ScenarioError, WireError
from ..net import topics
from ..net.messages import READABLE, STATE_VECTORS, Event, LinkStats, State
from ..net.wire import decode
from ..scenario import Scenario, command_from, parse
from .chunks import Walk
from .writer import ACCOUNTS, SCENARIO, SESSION

Ints = NDArray[np.int64]
M = TypeVar("M", Event, LinkStats)


class SiteLog:
    """The records of one site, in tick order, each tick once.

    Args:
        name: the site.
        peers: its peers, in scenario order.
        rate_hz: its tick rate.
        payloads: the records as published.
        source: what errors call the file.

    Attributes:
        name: the site.
        peers: its peers, in scenario order.
        rate_hz: its tick rate, Hz.
        payloads: the records as published, in tick order.
        states: the same, decoded.
    """

    def __init__(
        self, name: str, peers: tuple[str, ...], rate_hz: int, payloads: Sequence[bytes], source: str
    ) -> None:
        self.name = name
        self.peers = peers
        self.rate_hz = rate_hz
        try:
            with collector.paused():
                pairs = [(decode(payload, State, READABLE), payload) for payload in payloads]
        except WireError as error:
            raise LogError(f"{source}: a record of {name} cannot be read: {error}") from None
        pairs.sort(key=lambda pair: pair[0].tick)
        self.states = [state for state, _ in pairs]
        self.payloads = [payload for _, payload in pairs]

    def __len__(self) -> int:
        return len(self.states)

    def _vectors(self, field: str) -> Array:
        rows = [getattr(state, field) for state in self.states]
        vectors: Array = np.array(rows, dtype=np.float64).reshape(-1, STATE_VECTORS[field])
        return vectors

    def _numbers(self, field: str) -> Ints:
        return np.array([getattr(state, field) for state in self.states], dtype=np.int64)

    @cached_property
    def tick(self) -> Ints:
        """Ticks, shape (K,)."""
        return self._numbers("tick")

    @cached_property
    def t_s(self) -> Array:
        """Nominal time since the epoch, shape (K,), s."""
        return self._numbers("t_ns") / NS_PER_S

    @cached_property
    def q(self) -> Array:
        """Joint angles, shape (K, 2), rad."""
        return self._vectors("q")

    @cached_property
    def qd(self) -> Array:
        """Joint velocities, shape (K, 2), rad/s."""
        return self._vectors("qd")

    @cached_property
    def q_des(self) -> Array:
        """Reference of Eq. (6), shape (K, 2), rad."""
        return self._vectors("q_des")

    @cached_property
    def qd_des(self) -> Array:
        """Its derivative, shape (K, 2), rad/s."""
        return self._vectors("qd_des")

    @property
    def e(self) -> Array:
        """Position error q - q_des, Eq. (9), shape (K, 2), rad."""
        return self.q - self.q_des

    @cached_property
    def tau(self) -> Array:
        """Control torque of Eq. (13), shape (K, 2), N m."""
        return self._vectors("tau")

    @cached_property
    def tau_x(self) -> Array:
        """Exogenous torque in the sign of Eq. (8), shape (K, 2), N m; ON the arm acts its negative."""
        return self._vectors("tau_x")

    @cached_property
    def theta_hat(self) -> Array:
        """Estimate of the parameters, Eq. (15), shape (K, 5)."""
        return self._vectors("theta_hat")

    @cached_property
    def late_us(self) -> Ints:
        """Wake-up minus deadline, shape (K,), us; 0 in virtual time."""
        return self._numbers("late_us")

    @cached_property
    def busy_us(self) -> Ints:
        """Computing time of each tick, shape (K - 1,), us: record k + 1 carries that of tick k."""
        return self._numbers("busy_us")[1:]

    @cached_property
    def used(self) -> dict[str, Ints]:
        """Per peer the tick of the sample in use, shape (K,); -1 before the first."""
        return {
            peer: np.array([state.used.get(peer, -1) for state in self.states], dtype=np.int64)
            for peer in self.peers
        }

    def age_s(self, peer: str, rate_hz: int) -> Array:
        """Returns now minus the stamp of the sample in use, shape (K,), s; NaN before the first.

        Args:
            peer: which peer.
            rate_hz: that peer's tick rate.
        """
        used = self.used[peer]
        age = self._numbers("t_ns") - used * NS_PER_S // rate_hz
        seconds: Array = np.where(used >= 0, age / NS_PER_S, np.nan)
        return seconds


class Log:
    """A session as it was recorded; `log["m1"]` is a site's part.

    Attributes:
        source: the file's name.
        session: what the file says of the session: driver, seed, epoch, versions, commit, fingerprint.
        scenario: the scenario that ran.
        scenario_sha256: hash of its text in the file.
        events: what happened, in file order.
        accounts: per topic what arrived and what is missing, as written at the end; {} in a torn file.
        complete: False where the file was not finished.
    """

    def __init__(self, walk: Walk, source: str) -> None:
        self.source = source
        payloads: dict[str, list[bytes]] = {}
        for item in walk.messages():
            payloads.setdefault(item.topic, []).append(item.payload)
        self.session = walk.metadata.get(SESSION, {})
        lacking = {"session", "driver"} - self.session.keys() or {SCENARIO} - walk.attachments.keys()
        if lacking:
            raise LogError(f"{source}: is an MCAP file, but no log of trilat-net: no {lacking.pop()}")
        try:
            text = walk.attachments[SCENARIO]
            self.scenario_sha256 = hashlib.sha256(text).hexdigest()
            self.scenario: Scenario = parse(text.decode(), f"{source}: scenario")
        except (ScenarioError, UnicodeDecodeError) as error:
            raise LogError(f"{source}: its scenario cannot be read: {error}") from None
        self.accounts = walk.metadata.get(ACCOUNTS, {})
        self.complete = walk.complete
        self._payloads = payloads
        self._sites: dict[str, SiteLog] = {}
        self.events = [
            message
            for topic in sorted(payloads)
            if topic.endswith(f"/{topics.EVENT}")
            for message in self._decoded(topic, Event)
        ]

    def _topic(self, member: str, channel: str) -> str:
        return "/" + topics.key(self.session["session"], member, channel)

    def _decoded(self, topic: str, kind: type[M]) -> Iterator[M]:
        try:
            for payload in self._payloads.get(topic, []):
                yield decode(payload, kind, READABLE)
        except WireError as error:
            raise LogError(f"{self.source}: a message on {topic} cannot be read: {error}") from None

    def account(self, site: str) -> str:
        """Returns what arrived of a site's records and what is missing; "" in an unfinished file."""
        return self.accounts.get(self._topic(site, topics.STATE), "")

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of the sites, in scenario order."""
        return self.scenario.names

    @property
    def driver(self) -> str:
        """What drove the session: "live" or "virtual"."""
        return self.session["driver"]

    def __getitem__(self, site: str) -> SiteLog:
        if site not in self.scenario.sites:
            raise KeyError(f"no site {site!r} in {self.source}; it has {', '.join(self.sites)}")
        if site not in self._sites:
            self._sites[site] = SiteLog(
                site,
                self.scenario.peers(site),
                self.scenario.sites[site].rate_hz,
                self._payloads.get(self._topic(site, topics.STATE), []),
                self.source,
            )
        return self._sites[site]

    def changes(self, site: str) -> dict[int, list[str]]:
        """Returns the texts of the changes that a site took in, by tick, in order.

        They stand in its records, and in its events, which tell of those whose record is missing.
        """
        named = {state.tick: state.cmd for state in self[site].states if state.cmd}
        have = set(self[site].tick.tolist())
        for event in self.events:
            if event.kind == "change" and event.member == site and event.ticks not in have:
                named.setdefault(event.ticks, []).append(event.command)
        return dict(sorted(named.items()))

    def commands(self, site: str) -> dict[int, list[Command]]:
        """Returns the same, as the site took them in.

        Raises:
            LogError: the log names a change that is none.
        """
        try:
            return {
                tick: [command_from(self.scenario, site, text) for text in texts]
                for tick, texts in self.changes(site).items()
            }
        except ScenarioError as error:
            raise LogError(f"{self.source}: {error}") from None

    def link_stats(self, site: str) -> list[LinkStats]:
        """Returns the statistics that a site published, in order."""
        return list(self._decoded(self._topic(site, topics.LINK), LinkStats))


def open_log(source: str | Path | BinaryIO) -> Log:
    """Returns the log in a file.

    Args:
        source: a path, or a file opened for reading.

    Raises:
        LogError: the file is missing, is no MCAP file, or no log of trilat-net.
    """
    if isinstance(source, str | Path):
        try:
            with Path(source).open("rb") as stream:
                return Log(Walk(stream, str(source)), str(source))
        except OSError as error:
            raise LogError(f"{source}: cannot be read: {error.strerror}") from None
    return Log(Walk(source, "log"), "log")
