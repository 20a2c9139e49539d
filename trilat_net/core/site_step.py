"""A site, and `Site.step`: the one place that computes a site's tick.

Invariant: a site advances by `step` alone, and `step` is a pure function of the site's state and the
tick's input: no clock, no socket, no chance. Live, in virtual time and from a log, the same ticks give
the same bits.

`Site` is thin Python around `kernel.site_tick`: it packs arrivals and unpacks the record.
"""

import struct
import zlib
from collections.abc import Sequence

import numpy as np

from .channel import LOST
from .delay import DelayKind, LinkModel
from .kernel import accept_stage, act_stages, resume_stages, sense_stages, site_tick
from .link import release_tick
from .site_arrays import ARRIVAL_DTYPE, ROW_FLOATS, add_ramp, build_site_arrays
from .site_setup import SiteSetup
from .ticks import MAX_ARRIVALS, NS_PER_S, Arrival, CoreChange, LinkCounts, Mode, TickInput, TickRecord
from .two_link_arm import JOINTS
from .user_law import LawContext, LawInput, UserLaw, call_law, restore_law
from .vectors import Row

_ARRIVAL_LAYOUT = struct.Struct(f"<qq{2 * JOINTS}d")
_PACK_ARRIVAL, _PACK_ARRIVAL_SIZE = _ARRIVAL_LAYOUT.pack_into, _ARRIVAL_LAYOUT.size
_MODES = {int(mode): mode for mode in Mode}
_RUN, _DIVERGED = int(Mode.RUN), int(Mode.DIVERGED)

MAX_CHANGES = 256
"""Most changes of one link, or of the shares, that a site takes in a run besides its scenario's."""


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
        self._starts = [link.q0 for link in setup.links]
        self._external = setup.external
        tables = build_site_arrays(setup, MAX_CHANGES)
        self._tables = tables
        self._site, self._links, self._models = tables.site, tables.links, tables.models
        self._samples, self._calendars, self._points = tables.samples, tables.calendars, tables.points
        self._ramps, self._actors, self._table = tables.ramps, tables.actors, tables.table
        self._row = np.zeros(ROW_FLOATS)
        self._arrivals = np.zeros(MAX_ARRIVALS, ARRIVAL_DTYPE)
        self._arrival_bytes = self._arrivals.view(np.uint8).data
        self._forces = np.zeros((MAX_ARRIVALS, JOINTS))
        self._force_bytes = self._forces.view(np.uint8).reshape(-1).data
        self._own = None if setup.own is None else setup.own(_facts(setup))
        self._reflects = any(setup.gains.k_f) or self._own is not None

    def _add_model(self, peer: int, model: LinkModel) -> None:
        link: Row = self._links[peer]
        models, count = self._models[peer], int(link.models)
        place = 1 + int(np.searchsorted(models["from_ns"][1:count], model.from_ns, side="right"))
        models[place + 1 : count + 1] = models[place:count].copy()
        models[place] = model
        link.models = count + 1
        if link.model >= place:  # samples from ahead have been foreseen already: they stay as they are
            link.model += 1

    def order(self, command: CoreChange) -> None:
        """Takes in a change; one that its scenario or an earlier command plans for later still comes then.

        Raises:
            ValueError: the site has taken `MAX_COMMANDS` of them.
        """
        if command.model is not None:
            if self._links[command.peer].models >= self._models.shape[1]:
                raise ValueError(f"a run takes at most {MAX_CHANGES} changes of a link")
            self._add_model(command.peer, command.model)
        if command.ramp is not None:
            if self._site[0].ramps >= len(self._ramps):
                raise ValueError(f"a run takes at most {MAX_CHANGES} changes of its shares")
            add_ramp(self._tables, command.ramp)

    def step(self, tick: TickInput) -> TickRecord:
        """Computes one tick and returns its record.

        Args:
            tick: its number, one more than the last one's, and what came in since then.

        Raises:
            ValueError: more than MAX_ARRIVALS arrivals, or MAX_COMMANDS commands.
            LawFailed: a law of somebody's own did.
        """
        taken = self._pack(tick.arrivals)
        for command in tick.commands:
            self.order(command)
        if tick.measured is not None and self._external:
            s: Row = self._site[0]
            s.q, s.qd = tick.measured
        t_ns = tick.k * NS_PER_S // self.rate_hz
        looked = (
            tick.k,
            t_ns,
            len(tick.arrivals),
            self._site,
            self._links,
            self._models,
            self._samples,
            self._calendars,
            self._points,
            self._ramps,
            self._arrivals,
            self._forces,
        )
        own: list[float] = []
        if self._own is None:
            site_tick(*looked, self._actors, self._table, self._row)
        else:
            sense_stages(*looked)
            own = self._ask(self._own, tick.k)
            act_stages(tick.k, t_ns, self._site, self._actors, self._table, self._row)
        row = self._row.tolist()
        n = JOINTS
        mode = self._site["mode"].item()
        return TickRecord(
            tick.k,
            t_ns,
            _MODES[mode],
            row[:n],
            row[n : 2 * n],
            row[2 * n : 3 * n],
            row[3 * n : 4 * n],
            row[4 * n : 5 * n],
            row[5 * n : 6 * n],
            row[6 * n :],
            self._links["used"].tolist(),
            self._crc(taken, len(tick.arrivals)),
            [command.text for command in tick.commands],
            [] if mode in (_RUN, _DIVERGED) and self._own is None else self._memory() + own,
        )

    def _ask(self, law: UserLaw, k: int) -> list[float]:
        """Stage 6 of a law of somebody's own: takes its torque and estimate in, and returns its memory."""
        s: Row = self._site[0]
        vectors = (s.q, s.qd, s.q_des, s.qd_des, s.felt)
        now = LawInput(k, k / self.rate_hz, 1.0 / self.rate_hz, *(vector.tolist() for vector in vectors))
        torque, estimate, memory = call_law(law, self.name, now)
        limit = float(s.tau_limit)
        s.tau = [min(max(value, -limit), limit) for value in torque]
        s.theta_hat = estimate
        return memory

    def _crc(self, taken: int, arrivals: int) -> int:
        """Returns `Output.rx_crc`."""
        crc = zlib.crc32(self._arrival_bytes[:taken])
        return zlib.crc32(self._force_bytes[: arrivals * 8 * JOINTS], crc) if self._reflects else crc

    def _memory(self) -> list[float]:
        """Returns `Output.mem` of a site that holds, brakes or returns."""
        s: Row = self._site[0]
        return [*s.q_held.tolist(), float(s.return_from_ns)]

    def counts(self) -> tuple[LinkCounts, ...]:
        """Returns what each link has counted since the start, in scenario order."""
        return tuple(LinkCounts(*(int(link[field]) for field in LinkCounts._fields)) for link in self._links)

    def release_tick(self, peer: int, tick: int) -> int | None:
        """Returns the tick of this site at which a peer's sample comes into use if it is there by then.

        None where it never does: its link loses it, or forgot it long ago.
        """
        channel = self._links[peer], self._models[peer], self._samples[peer], self._points
        release = int(release_tick(tick, *channel, self.rate_hz))
        return None if release == LOST else release

    def measures(self, peer: int) -> bool:
        """True where a peer's samples are in use as soon as they have come: then none is late."""
        link: Row = self._links[peer]
        return bool(self._models[peer, link.model]["kind"] == DelayKind.MEASURED)

    def peer_rate_hz(self, peer: int) -> int:
        """Returns the tick rate of a peer, Hz."""
        return int(self._links[peer]["rate_hz"])

    def resume(self, before: TickRecord, last: TickRecord) -> None:
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
        if last.mem:
            s.q_held, s.return_from_ns = last.mem[:JOINTS], int(last.mem[JOINTS])
        if self._own is not None:
            restore_law(self._own, self.name, last.mem[JOINTS + 1 :])
        resume_stages(last.tick, self._site, self._actors, self._table)

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
        for link, start, sample in zip(self._links, self._starts, in_use, strict=True):
            # the channel's memory is a function of what went before
            link.foreseen, link.model, link.due_before = -1, 0, 0
            if sample is None:
                link.used, link.q, link.qd, link.tau_x = -1, start, 0.0, 0.0
            else:
                link.used, link.q, link.qd = sample.tick, sample.q, sample.qd
                link.tau_x = sample.tau_x
        self._pack(waiting)
        accept_stage(
            k,
            len(waiting),
            self._site,
            self._links,
            self._models,
            self._samples,
            self._calendars,
            self._points,
            self._arrivals,
            self._forces,
        )

    def _pack(self, arrivals: Sequence[Arrival]) -> int:
        """Writes arrivals into their table; returns the bytes that they take."""
        if len(arrivals) > MAX_ARRIVALS:
            raise ValueError(f"a tick takes at most {MAX_ARRIVALS} arrivals, got {len(arrivals)}")
        offset = 0
        for peer, tick, q, qd, _, _ in arrivals:
            _PACK_ARRIVAL(self._arrival_bytes, offset, peer, tick, *q, *qd)
            offset += _PACK_ARRIVAL_SIZE
        if self._reflects:
            for n, arrival in enumerate(arrivals):
                self._forces[n] = arrival.tau_x
        return offset


def _facts(setup: SiteSetup) -> LawContext:
    """Returns what a law may know of its site."""
    theta = tuple(float(value) for value in setup.theta) if setup.theta_known else ()
    return LawContext(setup.name, setup.rate_hz, setup.g_m_s2, setup.lengths_m, theta, setup.tau_limit_nm)
