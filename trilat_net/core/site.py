"""A site, and `Site.step`: the one place where a site's tick is computed.

Law: a site advances by `step` alone, and `step` is a pure function of the site's state and the tick:
no clock, no socket, no chance. Live, in virtual time and from a log, the same ticks give the same bits.

`Site` is thin Python around `kernel.site_tick`: it packs arrivals in and unpacks the record.
"""

import struct
import zlib
from collections.abc import Sequence

import numpy as np

from .arm import JOINTS
from .grid import NS_PER_S
from .kernel import ARRIVAL, ROW_FLOATS, SITE, site_accept, site_resume, site_tick
from .link import LINK, SAMPLE, Row, calendar_pages, release_tick
from .setup import SiteSetup
from .tick import MAX_ARRIVALS, Arrival, LinkCounts, Mode, Output, Tick

_ARRIVAL_LAYOUT = struct.Struct(f"<qq{2 * JOINTS}d")
_PACK_ARRIVAL, _PACK_ARRIVAL_SIZE = _ARRIVAL_LAYOUT.pack_into, _ARRIVAL_LAYOUT.size
_MODES = {int(mode): mode for mode in Mode}


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
        self._site = np.zeros(1, SITE)
        self._pulses = np.ascontiguousarray(setup.pulses, dtype=np.float64)
        self._row = np.zeros(ROW_FLOATS)
        self._arrivals = np.zeros(MAX_ARRIVALS, ARRIVAL)
        self._arrival_bytes = self._arrivals.view(np.uint8).data
        self._fill(setup)
        self._connect(setup)

    def _fill(self, setup: SiteSetup) -> None:
        s: Row = self._site[0]
        s.rate_hz, s.scheme, s.mode = setup.rate_hz, int(setup.scheme), int(Mode.RUN)
        s.g, s.tau_limit, s.qd_limit = setup.g_m_s2, setup.tau_limit_nm, setup.qd_limit_rad_s
        for name in ("theta", "Lambda", "Kp", "Kd", "Gamma"):
            s[name] = getattr(setup, name)
        s.q, s.qd, s.theta_hat = setup.q0, setup.qd0, setup.theta_hat0

    def _connect(self, setup: SiteSetup) -> None:
        peers = len(setup.links)
        pages = max(calendar_pages(link.delay_ns, max(link.rate_hz, setup.rate_hz)) for link in setup.links)
        self._links = np.zeros(peers, LINK)
        self._samples = np.zeros((peers, pages), SAMPLE)
        self._samples["tick"] = -1
        self._calendars = np.full((peers, pages), -1, dtype=np.int64)
        row: Row
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
        return tuple(LinkCounts(*(int(link[field]) for field in LinkCounts._fields)) for link in self._links)

    def release_tick(self, peer: int, tick: int) -> int:
        """Returns the tick of this site at which a peer's sample comes into use if it is there by then."""
        return int(release_tick(tick, self._links[peer], self.rate_hz))

    def peer_rate_hz(self, peer: int) -> int:
        """Returns the tick rate of a peer, Hz."""
        return int(self._links[peer]["rate_hz"])

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
        link: Row
        for link, sample in zip(self._links, in_use, strict=True):
            if sample is not None:
                link.used, link.q, link.qd = sample.tick, sample.q, sample.qd
        self._pack(waiting)
        site_accept(k, len(waiting), self._site, self._links, self._samples, self._calendars, self._arrivals)

    def _pack(self, arrivals: Sequence[Arrival]) -> int:
        """Writes arrivals into their table; returns the bytes that they take."""
        if len(arrivals) > MAX_ARRIVALS:
            raise ValueError(f"a tick takes at most {MAX_ARRIVALS} arrivals, got {len(arrivals)}")
        offset = 0
        for peer, tick, q, qd, _ in arrivals:
            _PACK_ARRIVAL(self._arrival_bytes, offset, peer, tick, *q, *qd)
            offset += _PACK_ARRIVAL_SIZE
        return offset
