"""A site, and `Site.step`: the one place where a site's tick is computed.

Law: a site advances by `step` alone, and `step` is a pure function of the site's state and the tick:
no clock, no socket, no chance. Live, in virtual time and from a log, the same ticks give the same bits.

The eight stages of a tick stand in `site_tick` in the order of docs/design.md; each is a leaf of its own
module. `Site` is the thin Python around it: it packs arrivals in and unpacks the record.
"""

import math
import struct
import zlib
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from . import control
from .arm import JOINTS, PARAMETERS, Array, regressor
from .exogenous import torque_on_arm
from .grid import NS_PER_S, tick_ns
from .integrator import STAGE_ROWS, advance
from .jit import leaf
from .link import LINK, SAMPLE, Row, Rows, Ticks, accept, calendar_pages, recall, release_tick

MAX_ARRIVALS = 4096
"""Most arrivals that one tick takes in; a driver leaves the rest for the next one."""


class Mode(IntEnum):
    """What a site is doing in a tick. Edges: RUN -> DIVERGED (a limit was passed), and no other."""

    RUN = 1
    DIVERGED = 2


class Scheme(IntEnum):
    """How the continuous law is sampled.

    SECOND_ORDER extrapolates the torque to mid-period and updates the estimate by the trapezoid rule;
    DIGITAL is zero-order hold and forward Euler, what a plain digital controller does.
    """

    SECOND_ORDER = 0
    DIGITAL = 1


class LinkSetup(NamedTuple):
    """One peer as a site sees it.

    Attributes:
        peer: the peer's name.
        alpha: its share in this site's reference, Eq. (6), dimensionless.
        delay_ns: delay of the link from it, ns.
        rate_hz: the peer's tick rate, Hz.
        q0: the peer's start pose, rad, in use until its first sample is due (L7).
    """

    peer: str
    alpha: float
    delay_ns: int
    rate_hz: int
    q0: tuple[float, ...]


class SiteSetup(NamedTuple):
    """All that a site is built from; nothing else influences its numbers.

    Attributes:
        name: the site's name.
        rate_hz: tick rate, Hz.
        scheme: how the law is sampled.
        theta: true parameters of the arm, shape (5,).
        g_m_s2: gravitational acceleration, m/s^2.
        Lambda: shape (n,), 1/s.
        Kp: shape (n,), N m s/rad.
        Kd: shape (n,), N m s/rad.
        Gamma: adaptation gain per parameter, shape (5,).
        theta_hat0: the first estimate, shape (5,).
        tau_limit_nm: largest control torque of a joint, N m.
        qd_limit_rad_s: joint speed beyond which the run has left the physics, rad/s.
        q0: start pose, rad.
        qd0: start velocity, rad/s.
        pulses: the operator's torque pulses, shape (P, 2 + n), see `exogenous`.
        links: the peers in scenario order.
    """

    name: str
    rate_hz: int
    scheme: Scheme
    theta: Array
    g_m_s2: float
    Lambda: Array
    Kp: Array
    Kd: Array
    Gamma: Array
    theta_hat0: Array
    tau_limit_nm: float
    qd_limit_rad_s: float
    q0: tuple[float, ...]
    qd0: tuple[float, ...]
    pulses: Array
    links: tuple[LinkSetup, ...]


class Arrival(NamedTuple):
    """One sample as it came in.

    Attributes:
        peer: index of the peer among the site's links.
        tick: the sample's tick, at the peer's rate.
        q: the peer's joint angles, rad.
        qd: its joint velocities, rad/s.
        latency_us: how long it was under way, microseconds; telemetry, enters no formula.
    """

    peer: int
    tick: int
    q: Sequence[float]
    qd: Sequence[float]
    latency_us: int = 0


class Tick(NamedTuple):
    """One call of `Site.step`: the tick's number and what came in since the one before, in order."""

    k: int
    arrivals: Sequence[Arrival] = ()


class Output(NamedTuple):
    """The record of one tick: the state AT t_k and what followed from it, never the advanced state.

    Attributes:
        tick: k.
        t_ns: nominal time, ns since the epoch.
        mode: what the site was doing.
        q: joint angles, rad.
        qd: joint velocities, rad/s.
        q_des: reference q_id, Eq. (6), rad.
        qd_des: its derivative, rad/s.
        tau: control torque, Eq. (13), N m.
        tau_x: exogenous torque in the sign of Eq. (8), N m; the torque ON the arm is its negative.
        theta_hat: estimate of the parameters.
        used: tick of the sample in use, per peer in scenario order; -1 before the first.
        rx_crc: CRC-32 of this tick's arrivals as the step took them in, little-endian
            (peer i64, tick i64, q f64s, qd f64s) each; shows a changed input at its own tick.
    """

    tick: int
    t_ns: int
    mode: Mode
    q: list[float]
    qd: list[float]
    q_des: list[float]
    qd_des: list[float]
    tau: list[float]
    tau_x: list[float]
    theta_hat: list[float]
    used: list[int]
    rx_crc: int


class LinkCounts(NamedTuple):
    """What one link has counted since the start: samples accepted, and of those late, duplicate, refused."""

    accepted: int
    late: int
    duplicate: int
    refused: int


_VECTOR = (JOINTS,)
_SITE = np.dtype(
    (
        np.record,
        [
            ("rate_hz", "i8"),
            ("scheme", "i8"),
            ("mode", "i8"),
            ("g", "f8"),
            ("tau_limit", "f8"),
            ("qd_limit", "f8"),
            ("theta", "f8", (PARAMETERS,)),
            ("Lambda", "f8", _VECTOR),
            ("Kp", "f8", _VECTOR),
            ("Kd", "f8", _VECTOR),
            ("Gamma", "f8", (PARAMETERS,)),
            # the state
            ("q", "f8", _VECTOR),
            ("qd", "f8", _VECTOR),
            ("theta_hat", "f8", (PARAMETERS,)),
            ("tau", "f8", _VECTOR),
            ("tau_before", "f8", _VECTOR),
            ("Yr", "f8", (PARAMETERS,)),
            ("Yr_before", "f8", (PARAMETERS,)),
            # what a tick computes on its way
            ("q_des", "f8", _VECTOR),
            ("qd_des", "f8", _VECTOR),
            ("on_arm", "f8", _VECTOR),
            ("e", "f8", _VECTOR),
            ("ed", "f8", _VECTOR),
            ("r", "f8", _VECTOR),
            ("v", "f8", _VECTOR),
            ("a", "f8", _VECTOR),
            ("u", "f8", _VECTOR),
            ("q_kept", "f8", _VECTOR),
            ("qd_kept", "f8", _VECTOR),
            ("Y", "f8", (JOINTS, PARAMETERS)),
            ("work", "f8", (STAGE_ROWS, JOINTS)),
        ],
    )
)
_ARRIVAL = np.dtype(
    (np.record, [("peer", "i8"), ("tick", "i8"), ("q", "f8", _VECTOR), ("qd", "f8", _VECTOR)])
)
_ARRIVAL_LAYOUT = struct.Struct(f"<qq{2 * JOINTS}d")
_PACK_ARRIVAL, _PACK_ARRIVAL_SIZE = _ARRIVAL_LAYOUT.pack_into, _ARRIVAL_LAYOUT.size
_MODES = {int(mode): mode for mode in Mode}

# Where each vector of a record lies in the row of floats that a tick emits.
_EMITTED = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")
ROW_FLOATS = 6 * JOINTS + PARAMETERS

_RUN, _DIVERGED = int(Mode.RUN), int(Mode.DIVERGED)
_DIGITAL = int(Scheme.DIGITAL)


@leaf
def _reference(links: Rows, q_des: Array, qd_des: Array) -> None:
    """Writes q_id and its derivative, Eq. (6), summing over peers in scenario order."""
    q_des[:] = 0.0
    qd_des[:] = 0.0
    for j in range(links.shape[0]):
        link: Row = links[j]
        for i in range(q_des.shape[0]):
            q_des[i] += link.alpha * link.q[i]
            qd_des[i] += link.alpha * link.qd[i]


@leaf
def _errors_and_regressor(site: Row) -> None:
    """Writes e, ed, r, the regressor of Eq. (12) and Y' r from q, qd and the reference."""
    control.errors(site.q, site.qd, site.q_des, site.qd_des, site.Lambda, site.e, site.ed, site.r)
    for i in range(site.q.shape[0]):
        site.v[i] = -site.Lambda[i] * site.e[i]
        site.a[i] = -site.Lambda[i] * site.ed[i]
    regressor(site.g, site.q, site.qd, site.v, site.a, site.Y)
    control.regressor_transpose_times(site.Y, site.r, site.Yr)


@leaf
def _finite(site: Row) -> bool:
    """True while the arm's state is made of numbers that a record can hold."""
    for i in range(site.q.shape[0]):
        if not (math.isfinite(site.q[i]) and math.isfinite(site.qd[i])):
            return False
    return True


@leaf
def _within_limits(site: Row) -> bool:
    """True while every joint speed is within the divergence stop."""
    for i in range(site.qd.shape[0]):
        if not abs(site.qd[i]) <= site.qd_limit:
            return False
    return True


@leaf
def _emit(site: Row, row: Array) -> None:
    """Writes the record's floats in the order of _EMITTED."""
    n = site.q.shape[0]
    for i in range(n):
        row[i] = site.q[i]
        row[n + i] = site.qd[i]
        row[2 * n + i] = site.q_des[i]
        row[3 * n + i] = site.qd_des[i]
        row[4 * n + i] = site.tau[i]
        row[5 * n + i] = 0.0 - site.on_arm[i]  # 0.0, never -0.0, where nothing acts
    for p in range(site.theta_hat.shape[0]):
        row[6 * n + p] = site.theta_hat[p]


@leaf
def _advance(k: int, site: Row, pulses: Array) -> None:
    """Stage 8: carries the state from t_k to t_{k+1} and remembers what tick k+1 needs of tick k."""
    h_s = 1.0 / site.rate_hz
    for i in range(site.u.shape[0]):
        if site.scheme == _DIGITAL or k == 0:
            site.u[i] = site.tau[i]
        else:
            ahead = 1.5 * site.tau[i] - 0.5 * site.tau_before[i]
            site.u[i] = min(max(ahead, -site.tau_limit), site.tau_limit)
    site.q_kept[:] = site.q
    site.qd_kept[:] = site.qd
    t_s = tick_ns(k, site.rate_hz) * 1e-9
    advance(t_s, h_s, site.q, site.qd, site.u, site.theta, site.g, pulses, site.work)
    if not _finite(site):
        site.q[:] = site.q_kept
        site.qd[:] = site.qd_kept
        site.mode = _DIVERGED
    if site.scheme == _DIGITAL:
        control.estimate(site.theta_hat, h_s, site.Gamma, site.Yr)
    site.tau_before[:] = site.tau
    site.Yr_before[:] = site.Yr


@leaf
def site_accept(
    k: int, count: int, site: Rows, links: Rows, samples: Rows, calendars: Ticks, arrivals: Rows
) -> None:
    """Stage 1: takes the first `count` arrivals into their links; arguments as in `site_tick`."""
    rate_hz = site[0].rate_hz
    for n in range(count):
        arrival: Row = arrivals[n]
        j = arrival.peer
        accept(k, rate_hz, arrival.tick, arrival.q, arrival.qd, links[j], samples[j], calendars[j])


@leaf
def site_tick(
    k: int,
    count: int,
    site: Row,
    links: Rows,
    samples: Rows,
    calendars: Ticks,
    arrivals: Rows,
    pulses: Array,
    row: Array,
) -> None:
    """Computes one tick of one site; what `Site.step` and the virtual-time kernel both call.

    Args:
        k: the tick.
        count: how many rows of `arrivals` are filled.
        site: the site's state and constants, one row of dtype _SITE, shape (1,).
        links: one row per peer, shape (P,), dtype LINK.
        samples: where samples wait, shape (P, pages), dtype SAMPLE.
        calendars: the links' calendars, shape (P, pages).
        arrivals: what came in, shape (MAX_ARRIVALS,), dtype _ARRIVAL.
        pulses: the operator's torque, see `exogenous`.
        row: the record's floats in the order of _EMITTED, shape (ROW_FLOATS,); written.
    """
    s: Row = site[0]
    site_accept(k, count, site, links, samples, calendars, arrivals)  # 1 accept
    for j in range(links.shape[0]):  # 2 recall
        recall(k, links[j], samples[j], calendars[j])
    _reference(links, s.q_des, s.qd_des)  # 3 reference
    _errors_and_regressor(s)  # 4 errors
    if s.scheme != _DIGITAL and k > 0 and s.mode == _RUN:  # 5 estimate: the trapezoid rule, explicit
        half_s = 0.5 / s.rate_hz
        for p in range(s.Yr.shape[0]):
            s.theta_hat[p] -= half_s * s.Gamma[p] * (s.Yr_before[p] + s.Yr[p])
    control.torque(s.Y, s.theta_hat, s.Kp, s.Kd, s.r, s.ed, s.tau_limit, s.tau)  # 6 torque
    torque_on_arm(tick_ns(k, s.rate_hz) * 1e-9, pulses, s.on_arm)
    if not _within_limits(s):
        s.mode = _DIVERGED
    _emit(s, row)  # 7 emit
    if s.mode == _RUN:  # 8 advance
        _advance(k, s, pulses)


@leaf
def site_resume(k: int, site: Rows, pulses: Array) -> None:
    """Repeats the end of tick k (stages 4 and 8) from a state that was filled in from its record."""
    s: Row = site[0]
    _errors_and_regressor(s)
    if s.mode == _RUN:
        _advance(k, s, pulses)


class Site:
    """One manipulator with its controller and the receiving ends of its links.

    Args:
        setup: all that the site is built from.

    Attributes:
        name: the site's name.
        rate_hz: its tick rate, Hz.
        peers: names of its peers, in scenario order.
    """

    def __init__(self, setup: SiteSetup) -> None:
        self.name = setup.name
        self.rate_hz = setup.rate_hz
        self.peers = tuple(link.peer for link in setup.links)
        self._site = np.zeros(1, _SITE)
        self._pulses = np.ascontiguousarray(setup.pulses, dtype=np.float64)
        self._row = np.zeros(ROW_FLOATS)
        self._arrivals = np.zeros(MAX_ARRIVALS, _ARRIVAL)
        self._arrival_bytes = self._arrivals.view(np.uint8).data
        self._fill(setup)
        self._connect(setup)

    def _fill(self, setup: SiteSetup) -> None:
        s: Row = self._site[0]
        s.rate_hz, s.scheme, s.mode = setup.rate_hz, int(setup.scheme), _RUN
        s.g, s.tau_limit, s.qd_limit = setup.g_m_s2, setup.tau_limit_nm, setup.qd_limit_rad_s
        for name in ("theta", "Lambda", "Kp", "Kd", "Gamma"):
            s[name] = getattr(setup, name)
        s.q, s.qd, s.theta_hat = setup.q0, setup.qd0, setup.theta_hat0

    def _connect(self, setup: SiteSetup) -> None:
        peers = len(setup.links)
        pages = max(
            calendar_pages(link.delay_ns, max(link.rate_hz, setup.rate_hz)) for link in setup.links
        )
        self._links = np.zeros(peers, LINK)
        self._samples = np.zeros((peers, pages), SAMPLE)
        self._samples["tick"] = -1
        self._calendars = np.full((peers, pages), -1, dtype=np.int64)
        for row, link in zip(self._links, setup.links, strict=True):
            row.alpha, row.delay_ns, row.rate_hz = link.alpha, link.delay_ns, link.rate_hz
            row.used, row.q = -1, link.q0

    def step(self, tick: Tick) -> Output:
        """Computes one tick and returns its record.

        Args:
            tick: its number, one more than the last one's, and what came in since then.

        Raises:
            ValueError: more than MAX_ARRIVALS arrivals.
        """
        taken = self._pack(tick.arrivals)
        site_tick(
            tick.k,
            len(tick.arrivals),
            self._site,
            self._links,
            self._samples,
            self._calendars,
            self._arrivals,
            self._pulses,
            self._row,
        )
        row = self._row.tolist()
        n = JOINTS
        return Output(
            tick.k,
            tick.k * NS_PER_S // self.rate_hz,
            _MODES[self._site["mode"].item()],
            row[:n],
            row[n : 2 * n],
            row[2 * n : 3 * n],
            row[3 * n : 4 * n],
            row[4 * n : 5 * n],
            row[5 * n : 6 * n],
            row[6 * n :],
            self._links["used"].tolist(),
            zlib.crc32(self._arrival_bytes[:taken]),
        )

    def counts(self) -> tuple[LinkCounts, ...]:
        """Returns what each link has counted since the start, in scenario order."""
        return tuple(
            LinkCounts(*(int(link[field]) for field in LinkCounts._fields)) for link in self._links
        )

    def release_tick(self, peer: int, tick: int) -> int:
        """Returns the tick of this site at which a peer's sample comes into use if it is there by then."""
        return int(release_tick(tick, self._links[peer], self.rate_hz))

    def resume(self, before: Output, last: Output) -> None:
        """Puts the arm and its controller where `step(last.tick)` left them, from two records in a row.

        The links are left alone; see `prime`.

        Args:
            before: the record of the tick before the last one; any, where the last one is tick 0.
            last: the record of the last tick.
        """
        s: Row = self._site[0]
        s.mode = int(last.mode)
        s.q, s.qd, s.theta_hat = last.q, last.qd, last.theta_hat
        s.q_des, s.qd_des, s.tau, s.tau_before = last.q_des, last.qd_des, last.tau, before.tau
        site_resume(last.tick, self._site, self._pulses)

    def prime(self, k: int, in_use: Sequence[Arrival | None], waiting: Sequence[Arrival]) -> None:
        """Puts the links where they were before tick k: what is in use, and what waits to be.

        Args:
            k: the tick that will be stepped next.
            in_use: per peer the sample in use, or None before the first.
            waiting: arrivals that had not come into use.

        Raises:
            ValueError: more than MAX_ARRIVALS of them wait.
        """
        self._samples["tick"] = -1
        self._calendars[:] = -1
        for link, sample in zip(self._links, in_use, strict=True):
            if sample is not None:
                link.used, link.q, link.qd = sample.tick, sample.q, sample.qd
        self._pack(waiting)
        site_accept(
            k, len(waiting), self._site, self._links, self._samples, self._calendars, self._arrivals
        )

    def _pack(self, arrivals: Sequence[Arrival]) -> int:
        """Writes arrivals into their table; returns the bytes that they take."""
        if len(arrivals) > MAX_ARRIVALS:
            raise ValueError(f"a tick takes at most {MAX_ARRIVALS} arrivals, got {len(arrivals)}")
        offset = 0
        for peer, tick, q, qd, _ in arrivals:
            _PACK_ARRIVAL(self._arrival_bytes, offset, peer, tick, *q, *qd)
            offset += _PACK_ARRIVAL_SIZE
        return offset
