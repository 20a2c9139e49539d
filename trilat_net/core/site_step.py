"""A site, and `Site.step`: the one place that computes a site's tick.

Invariant: a site advances by `step` alone, and `step` is a pure function of the site's state
and the tick's input: no clock, no socket, no chance. Live, in virtual time and from a log, the
same ticks give the same bits.

`Site` is thin Python around `kernel.site_tick`: it packs arrivals and unpacks the record.
"""

import math
import struct
import zlib
from collections.abc import Callable, Sequence

import numpy as np

from ..errors import LawFailed
from .channel import LOST
from .compiled_law import plug_law
from .delay import DelayKind
from .exogenous import LIVE_KINDS
from .jit import bind_leaf
from .kernel import (
    accept_stage,
    act_stages,
    find_release,
    resume_stages,
    sense_stages,
    site_tick,
)
from .live_hand import HandInForce, empty_hand_vector
from .site_arrays import (
    MAX_CHANGES,
    MAX_RAMPS,
    CalendarSizer,
    SiteArrays,
    apply_change,
    build_site_arrays,
    build_tick_buffers,
)
from .site_setup import SiteSetup, StaleAction
from .ticks import (
    MAX_ARRIVALS,
    NS_PER_S,
    Arrival,
    CoreChange,
    LifeReason,
    LinkCounts,
    Mode,
    TickInput,
    TickRecord,
)
from .vectors import Array, Row

_MODES = {int(mode): mode for mode in Mode}
_RUN = int(Mode.RUN)
_DIVERGED = int(Mode.DIVERGED)
_NO_TASK: tuple[tuple[float, ...], ...] = ((), (), ())


class Site:
    """One manipulator with its controller and the receiving ends of its links.

    Args:
        setup: all that the site is built from.

    Attributes:
        name: the site's name.
        rate_hz: its tick rate, Hz.
        peers: names of its peers, in scenario order.
        layout: how many numbers its vectors have.
        law_failure: why a plugged law last failed, under the rule `glide`; None: it never did.
    """

    def __init__(self, setup: SiteSetup) -> None:
        self.name = setup.name
        self.rate_hz = setup.rate_hz
        self.peers = tuple(link.peer for link in setup.links)
        self._starts = [link.q0 for link in setup.links]
        self._room = CalendarSizer(setup)
        self._external = setup.external
        self._arrays = build_site_arrays(setup, (MAX_CHANGES, MAX_RAMPS))
        self.layout = setup.layout
        columns = self.layout.columns()
        columns.pop("ch", None)
        motion = tuple(columns.values())
        self._columns = motion[:7], motion[7:]
        self._buffers = build_tick_buffers(setup)
        arrival = struct.Struct(f"<qq{2 * self.layout.shared}d")
        self._pack_arrival = arrival.pack_into
        self._arrival_size = arrival.size
        self._tick_arrays = (*self._arrays, *self._buffers)
        self._tick: Callable[..., None] | None = None  # of a user's law the stages are called
        self._site = self._arrays.site
        self._links = self._arrays.links
        self._mode = self._site["mode"]
        self._used = self._links["used"]
        self._arrival_bytes = self._buffers.arrivals.view(np.uint8).data
        self._force_bytes = self._buffers.forces.view(np.uint8).reshape(-1).data
        self._sent = self._buffers.record[self.layout.floats - self.layout.sent :]
        self._plug_law(setup)
        live = [n for n, actor in enumerate(setup.actors) if actor.kind in LIVE_KINDS]
        self._hand = self._find_hand(live[0]) if live else None
        counts = [link.channel.received_size for link in setup.links]
        self._received_counts = counts if self._user_law is not None and any(counts) else None
        self._glides = setup.on_stale.action is StaleAction.GLIDE
        self._degrades = setup.on_stale.degrades
        self._law_memory: list[float] = (
            [] if self._law is None or not self._glides else self._law.memory
        )
        self._remembers = self._glides or self._user_law is not None
        s = self._site  # its fields are looked up once: that takes longer than to read them
        own = (
            s["q_held"][0],
            s["return_from_ns"],
            s["qd_held"][0],
            s["reason"],
            s["tau_held"][0],
        )
        rest = s["q_rest"][0], s["qd_rest"][0]
        self._held_fields = (*own, self._links["used_ns"], self._links["gone"], *rest)
        self._reflects = bool(np.any(setup.gains.k_f)) or self._user_law is not None
        # a hand of one's own sees them
        self._keeps_forces = self._reflects or self._hand is not None

    def _find_hand(self, place: int) -> tuple[Array, Array, Array]:
        """Returns grip, target, and target a second later of the live hand at a place among the
        actors.
        """
        actors = self._arrays.actors
        size = (self.layout.hand - 3) // 2
        return (
            actors["grip"][place : place + 1],
            actors["a"][place, :size],
            actors["b"][place, :size],
        )

    def _plug_law(self, setup: SiteSetup) -> None:
        """Makes the law of a setup that has its own."""
        self._user_law = (
            None if setup.law_factory is None else setup.law_factory(setup.law_context())
        )
        self._law = None
        self.law_failure: LawFailed | None = None
        if self._user_law is not None:
            a = self._arrays
            b = self._buffers
            self._law = plug_law(self._user_law, setup, a, self._sent)
            self._law.bind()  # compiled now, and not within the time that the law has for a tick
            self._sense = bind_leaf(sense_stages, 0, 0, 0, a, b)
            self._act = bind_leaf(
                act_stages, 0, 0, a.site, a.actors, a.table, a.chain, b.record
            )

    def apply_change(self, command: CoreChange, t_ns: int) -> None:
        """Takes in a change; one that is planned for later, by the scenario or an earlier
        order, still comes.

        Args:
            command: the change.
            t_ns: a time before which the site makes no more ticks, ns since the epoch.

        Raises:
            ValueError: the arrays have no more room for it.
        """
        apply_change(self._arrays, command, t_ns)
        if command.model is not None:
            self._room.lengthen(command.peer, command.model)

    def start_at(self, k: int) -> None:
        """Lets tick k be the first one, of a site that joins a running session; for a site
        without ticks.

        Its arm stands where it starts, no sample of a peer is in use, and none is under way;
        its channels are where they would be.
        """
        if k <= self._site["first"]:
            self.restore_links(k, [None] * len(self.peers), ())
        self._site["first"] = k
        for n, link in enumerate(self._links):
            sample = (k - 1) * int(link["rate_hz"]) // self.rate_hz
            if sample >= 0:
                find_release(n, sample, self._arrays)
        self._links["copies"] = 0

    def step(self, tick: TickInput) -> TickRecord:
        """Computes one tick and returns its record.

        Args:
            tick: its number, one more than the last one's, and the input since then.

        Raises:
            ValueError: more than MAX_ARRIVALS arrivals, or more changes than `apply_change` takes.
            LawFailed: a user's law did, and the site does not go on without it, as under
                `glide`.
        """
        t_ns = tick.k * NS_PER_S // self.rate_hz
        count = len(tick.arrivals)
        for command in tick.commands:
            self.apply_change(command, t_ns)
        packed = self._pack(tick.k, tick.arrivals)
        bodies: Sequence[float] = ()
        if tick.measured is not None and self._external:
            s: Row = self._site[0]
            bodies = tick.measured.bodies
            s.q = tick.measured.q
            s.qd = tick.measured.qd
            s.sensed = [-torque for torque in tick.measured.tau_x] or 0.0
        hand = self._take_hand(tick.hand)
        memory: list[float] = []
        if self._law is None:
            if self._tick is None:
                self._tick = bind_leaf(site_tick, 0, 0, 0, *self._tick_arrays)
            self._tick(tick.k, t_ns, count, *self._tick_arrays)
        else:
            self._sense(tick.k, t_ns, count, self._arrays, self._buffers)
            a = self._arrays
            memory = self._ask_law(tick.k, t_ns)
            self._act(tick.k, t_ns, a.site, a.actors, a.table, a.chain, self._buffers.record)
        row = self._buffers.record.tolist()
        motion, task = self._columns
        mode = self._mode.item()
        texts = [command.text for command in tick.commands]
        memory = (
            self._held_memory() + memory
            if self._remembers or mode not in (_RUN, _DIVERGED)
            else []
        )
        taken = self._used.tolist(), self._crc(packed, count), texts, memory
        states = [row[column] for column in motion]
        shared = [row[column] for column in task] or _NO_TASK
        sent = self._sent.tolist() or (), hand, bodies
        return TickRecord._make((tick.k, t_ns, _MODES[mode], *states, *taken, *shared, *sent))

    def _ask_law(self, k: int, t_ns: int) -> list[float]:
        """Stage 6 of a plugged law; returns its memory.

        Under the rule `glide` a law that fails gives no torque, which is a FAULT: it is not
        asked until that is reset, and then goes on from the memory that it had before it
        failed.
        """
        assert self._law is not None
        s: Row = self._site[0]
        if not self._glides:
            return self._law.compute(k, t_ns)
        if s.mode == Mode.FAULT and s.reason == LifeReason.NOT_FINITE:
            s.tau = math.nan
            return self._law_memory
        try:
            self._law_memory = self._law.compute(k, t_ns)
        except LawFailed as failure:
            self.law_failure = failure
            self._law.restore(self._law_memory)
            s.tau = math.nan
        return self._law_memory

    @property
    def speed_limits(self) -> list[float]:
        """Largest speed of each joint, rad/s."""
        limits: list[float] = self._site[0]["qd_limit"].tolist()
        return limits

    @property
    def mode(self) -> Mode:
        """Its mode at the last tick."""
        return _MODES[self._mode.item()]

    @property
    def life_reason(self) -> LifeReason:
        """Why it last changed its mode, under the rule `glide`."""
        return LifeReason(self._site["reason"].item())

    @property
    def arrays(self) -> SiteArrays:
        """What it is made of, as the next tick will find it; to be read, not written."""
        return self._arrays

    @property
    def q(self) -> list[float]:
        """Joint angles at the next tick, rad."""
        angles: list[float] = self._site[0]["q"][: self.layout.joints].tolist()
        return angles

    def _take_hand(self, vector: Sequence[float]) -> Sequence[float]:
        """Puts what a live hand does into its row; returns it as a record has it, () if there
        is none.
        """
        if self._hand is None:
            return ()
        grip, target, ahead = self._hand
        taken = list(vector) or empty_hand_vector(len(target))
        hand = HandInForce.read(taken)
        grip[0] = hand.grip
        target[:] = hand.target
        ahead[:] = [x + v for x, v in zip(hand.target, hand.rate, strict=True)]
        return taken

    def _crc(self, packed: int, arrivals: int) -> int:
        """Returns `TickRecord.rx_crc`."""
        crc = zlib.crc32(self._arrival_bytes[:packed])
        if self._reflects:
            crc = zlib.crc32(self._force_bytes[: arrivals * 8 * self.layout.shared], crc)
        if self._received_counts:
            for n, peer in enumerate(self._buffers.arrivals["peer"][:arrivals].tolist()):
                crc = zlib.crc32(self._buffers.sent[n, : self._received_counts[peer]].data, crc)
        return crc

    def _held_memory(self) -> list[float]:
        """Returns the part of `TickRecord.mem` that a site has which holds, brakes or returns."""
        q_held, return_from_ns, qd_held, reason, tau_held, used_ns, gone, pose, speed = (
            self._held_fields
        )
        held = [*q_held.tolist(), float(return_from_ns.item())]
        if not self._glides:
            return held
        heard = map(float, used_ns.tolist())
        lost = gone.tolist() if self._degrades else ()
        rest = (*pose.tolist(), *speed.tolist()) if self.layout.task else ()
        return [
            *held,
            *qd_held.tolist(),
            float(reason.item()),
            *heard,
            *tau_held.tolist(),
            *rest,
            *lost,
        ]

    def counts(self) -> tuple[LinkCounts, ...]:
        """Returns what each link has counted since the start, in scenario order."""
        return tuple(
            LinkCounts(*(int(link[field]) for field in LinkCounts._fields))
            for link in self._links
        )

    def release_tick(self, peer: int, tick: int) -> int | None:
        """Returns the tick of this site at which a peer's sample comes into use if it has
        arrived by then.

        None if it never does: its link loses it, or has turned its page.
        """
        release = int(find_release(peer, tick, self._arrays))
        return None if release == LOST else release

    def is_measured(self, peer: int) -> bool:
        """True if the link to this peer injects no delay: then no sample of it is late."""
        link: Row = self._links[peer]
        return bool(self._arrays.models[peer, link.model]["kind"] == DelayKind.MEASURED)

    def peer_rate_hz(self, peer: int) -> int:
        """Returns the tick rate of a peer, Hz."""
        return int(self._links[peer]["rate_hz"])

    def restore_state(self, before: TickRecord, last: TickRecord) -> None:
        """Restores the arm and its controller after `step(last.tick)`, from two records in a
        row.

        `restore_links` restores the links.

        Args:
            before: the record of the tick before the last one; any if that is tick 0.
            last: the record of the last tick.
        """
        s: Row = self._site[0]
        held = self.layout.shared
        s.mode = int(last.mode)
        s.q = last.q
        s.qd = last.qd
        s.theta_hat = last.theta_hat
        s.q_des = last.q_des
        s.qd_des = last.qd_des
        s.tau = last.tau
        s.tau_before = before.tau
        if last.mem:
            s.q_held = last.mem[:held]
            s.return_from_ns = int(last.mem[held])
        rest = last.mem[held + 1 :]
        if self._glides and rest:
            s.qd_held = rest[:held]
            s.reason = int(rest[held])
            rest = rest[held + 1 :]
            peers = len(self.peers)
            joints = self.layout.joints
            self._links["used_ns"] = rest[:peers]
            s.tau_held = rest[peers : peers + joints]
            rest = rest[peers + joints :]
            if self.layout.task:
                s.q_rest = rest[:joints]
                s.qd_rest = rest[joints : 2 * joints]
                rest = rest[2 * joints :]
            if self._degrades:
                self._links["gone"] = rest[:peers]
                rest = rest[peers:]
            s.order = s.skipped = 0
        self._sent[:] = last.ch or 0.0
        self._take_hand(last.hand)
        if self._law is not None:
            self._law.restore(rest)
            self._law_memory = list(rest)
        resume_stages(last.tick, self._arrays)

    def restore_links(
        self, k: int, in_use: Sequence[Arrival | None], waiting: Sequence[Arrival]
    ) -> None:
        """Restores the links before tick k.

        Args:
            k: the tick that will be stepped next.
            in_use: per peer the sample in use, or None before the first.
            waiting: arrivals that are not in use yet.

        Raises:
            ValueError: more than MAX_ARRIVALS of them wait.
        """
        self._arrays.calendars["tick"] = -1
        self._room.clear()
        link: Row
        for n, (link, start, sample) in enumerate(
            zip(self._links, self._starts, in_use, strict=True)
        ):
            # the channel's memory is a function of what went before
            link.scheduled = -1
            link.model = 0
            link.due_before = 0
            if sample is None:
                link.used = -1
                link.q = start
                link.qd = 0.0
                link.tau_x = 0.0
            else:
                link.used = sample.tick
                link.q = sample.q
                link.qd = sample.qd
                link.tau_x = sample.tau_x or 0.0
            if (channel := self._arrays.channel) is not None:
                # place -1 is this zero
                sent = np.append(() if sample is None else sample.ch, 0.0)
                channel.received[n] = sent[channel.places[n]] if len(sent) > 1 else 0.0
        self._pack(k, waiting)
        accept_stage(k, len(waiting), self._arrays, self._buffers)

    def _pack(self, k: int, arrivals: Sequence[Arrival]) -> int:
        """Writes arrivals at tick k into their buffers and makes room for them; returns their
        bytes there.
        """
        if len(arrivals) > MAX_ARRIVALS:
            raise ValueError(
                f"a tick takes at most {MAX_ARRIVALS} arrivals, got {len(arrivals)}"
            )
        offset = 0
        newest = self._room.newest
        for peer, tick, q, qd, *_ in arrivals:
            if tick > newest[peer]:
                self._arrays = self._room.make(self._arrays, k, peer, tick)
                self._tick_arrays = (*self._arrays, *self._buffers)
            self._pack_arrival(self._arrival_bytes, offset, peer, tick, *q, *qd)
            offset += self._arrival_size
        if self._keeps_forces:
            for n, arrival in enumerate(arrivals):
                self._buffers.forces[n] = arrival.tau_x or 0.0
        if self._received_counts:
            for n, arrival in enumerate(arrivals):
                self._buffers.sent[n, : self._received_counts[arrival.peer]] = arrival.ch or 0.0
        return offset
