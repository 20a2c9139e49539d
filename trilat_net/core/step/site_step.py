"""Runs the control loop of an arm, one period per call of `Site.step`.

The caller passes in the inputs of a period, such as the samples that arrived from other arms,
and gets back a record with all results. `Site.step` writes the samples to arrays, calls the
compiled function `kernel.site_tick`, and converts the results to a record. A control law
written by a user is called between the two halves of the period, which are compiled separately.

Invariant:
    - Live sessions, simulations and the verification of logs use `Site.step`. The only
      exception is the fast simulation of all arms (`fused_run`), which calls the same compiled
      functions.
    - The result of `Site.step` depends only on the state of the site and on its argument. The
      method reads no clock and no network connection, and draws no random numbers.
    - The same inputs always produce bit-identical results.
"""

import math
import struct
import zlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ...errors import LawFailed
from ..life.live_hand import HandInForce
from ..links.channel import LOST
from ..links.delay import DelayKind
from ..plug.compiled_law import plug_law
from .jit import bind_leaf
from .kernel import (
    accept_stage,
    act_stages,
    find_release,
    resume_stages,
    sense_stages,
    site_tick,
)
from .site_arrays import MAX_CHANGES, MAX_RAMPS, CalendarSizer, SiteArrays, TickBuffers
from .site_setup import SiteSetup
from .ticks import (
    MAX_ARRIVALS,
    NS_PER_S,
    RELEASE_REASONS,
    Arrival,
    CoreChange,
    LifeReason,
    LinkCounts,
    Mode,
    PlantState,
    TickInput,
    TickRecord,
)
from .vectors import Array, Row

_MODES = {int(mode): mode for mode in Mode}
_RUN = int(Mode.RUN)
_DIVERGED = int(Mode.DIVERGED)
_NO_SHARED: tuple[tuple[float, ...], ...] = ((), (), ())


class _TickParts(NamedTuple):
    """Internals of a `Site` that are used to compute many recorded control periods in one call.

    Attributes:
        buffers: Input and output of a tick.
        calendar_sizer: Enlarges the calendars in which samples wait.
        has_user_law: True if the control law is user-written.
        reflects: True if the law uses the external torques on the peers' arms.
        keeps_forces: True if the site stores these torques.
        glides: True if the arm comes to rest while a peer is silent (the rule `glide`).
        degrades: True if the site continues without lost peers.
        hand_index: Index of the person or program that moves the arm among the operators and
            environments, or -1 if nobody moves the arm.
    """

    buffers: TickBuffers
    calendar_sizer: CalendarSizer
    has_user_law: bool
    reflects: bool
    keeps_forces: bool
    glides: bool
    degrades: bool
    hand_index: int


class Site:
    """An arm with its controller, and the network links over which it receives samples.

    Each site process creates one `Site` and calls `step` once per control period. A simulation
    in virtual time does the same for each arm.

    Args:
        setup: Setup of the site.

    Attributes:
        name: Name of the site.
        rate_hz: Tick rate, Hz.
        peers: Names of the peers, in scenario order.
        layout: Lengths of the site's vectors.
        law_failure: Most recent failure of a user's law under the rule `glide`. None if the law
            has never failed.
    """

    def __init__(self, setup: SiteSetup) -> None:
        self.name = setup.name
        self.rate_hz = setup.rate_hz
        self.peers = tuple(link.peer for link in setup.links)
        self._start_poses = [link.q0 for link in setup.links]
        self._sizer = CalendarSizer(setup)
        self._external = setup.external
        self._arrays = SiteArrays.build(setup, (MAX_CHANGES, MAX_RAMPS))
        self.layout = setup.layout
        columns = self.layout.columns()
        columns.pop("ch", None)
        slices = tuple(columns.values())
        self._state_columns = slices[:7]
        self._shared_columns = slices[7:]
        self._buffers = TickBuffers.build(setup)
        arrival = struct.Struct(f"<qq{2 * self.layout.shared}d")
        self._pack_arrival = arrival.pack_into
        self._arrival_size = arrival.size
        self._tick_arrays = (*self._arrays, *self._buffers)
        self._tick: Callable[..., None] | None = None  # stays None with a user's law
        self._site = self._arrays.site
        self._links = self._arrays.links
        self._mode = self._site["mode"]
        self._used = self._links["used"]
        self._arrival_bytes = self._buffers.arrivals.view(np.uint8).data
        force_bytes = self._buffers.forces.view(np.uint8)
        self._force_bytes = force_bytes.reshape(-1).data
        sent_first = self.layout.floats - self.layout.sent
        self._sent = self._buffers.record[sent_first:]
        self._plug_law(setup)
        self._hand_index = setup.live_actor
        has_hand = self._hand_index >= 0
        self._hand = self._find_hand(self._hand_index) if has_hand else None
        received_counts = [link.channel.received_size for link in setup.links]
        reads_numbers = self._user_law is not None and any(received_counts)
        self._received_counts = received_counts if reads_numbers else None
        self._glides = setup.on_stale.glides
        self._degrades = setup.on_stale.degrades
        self._law_memory: list[float] = []
        if self._law is not None and self._glides:
            self._law_memory = self._law.memory
        self._remembers = self._glides or self._user_law is not None
        # Looking up a field of a structured array takes longer than reading its values.
        s = self._site
        self._q_held = s["q_held"][0]
        self._return_from_ns = s["return_from_ns"]
        self._qd_held = s["qd_held"][0]
        self._reason = s["reason"]
        self._tau_held = s["tau_held"][0]
        self._q_rest = s["q_rest"][0]
        self._qd_rest = s["qd_rest"][0]
        self._used_ns = self._links["used_ns"]
        self._gone = self._links["gone"]
        self._reflects = bool(np.any(setup.gains.k_f)) or self._user_law is not None
        # A user's program that moves the arm receives the forces that its site received.
        self._keeps_forces = self._reflects or self._hand is not None

    def _find_hand(self, index: int) -> tuple[Array, Array, Array]:
        """Returns the inputs of the spring through which a person or program pulls the arm.

        The inputs are the grip, which scales the force, and the target of the spring. They
        change in every control period.

        Args:
            index: Index of the live hand among the operators and environments.

        Returns:
            The grip, shape (1,), the target, and the target extrapolated by one second. They
            are views, so writing to them moves the live hand.
        """
        actors = self._arrays.actors
        # The field `hand` of a record contains grip, number, source, target and target
        # velocity.
        coordinates = (self.layout.hand - 3) // 2
        # The field `a` of a live hand is its target, and `b` the target one second later.
        grip = actors["grip"][index : index + 1]
        target = actors["a"][index, :coordinates]
        target_ahead = actors["b"][index, :coordinates]
        return grip, target, target_ahead

    def _plug_law(self, setup: SiteSetup) -> None:
        """Creates the user's control law, and compiles the other stages of a tick.

        A user's law is called between two compiled functions: `_sense` computes the stages of a
        tick before the torque, and `_act` those after it. If there is no such law, nothing is
        compiled here.

        `_user_law` is the user's object. `_law` calls this object with the arrays of this site,
        and may be a compiled form of the object. Both are None if there is no user law.

        Args:
            setup: Setup of the site, which may contain a factory for the law.
        """
        self._user_law = None
        if setup.law_factory is not None:
            self._user_law = setup.law_factory(setup.law_context())
        self._law = None
        self.law_failure: LawFailed | None = None
        if self._user_law is None:
            return

        arrays = self._arrays
        buffers = self._buffers
        self._law = plug_law(self._user_law, setup, arrays, self._sent)
        # Compile now, to avoid using up the law's time for a tick. Only the argument types
        # matter: the zeros stand for the tick, its time in ns, and the number of arrivals.
        self._law.bind()
        self._sense = bind_leaf(sense_stages, 0, 0, 0, arrays, buffers)
        self._act = bind_leaf(
            act_stages,
            0,
            0,
            arrays.site,
            arrays.actors,
            arrays.table,
            arrays.chain,
            buffers.record,
        )

    def apply_change(self, command: CoreChange, t_ns: int) -> None:
        """Applies a change to a running site, for example a new network delay.

        A change that takes effect later is stored until then.

        Args:
            command: The change.
            t_ns: Current time in ns since the start of the session. The site will not compute
                any further control period that starts before this time.

        Raises:
            ValueError: There are too many planned changes.
        """
        self._arrays.apply_change(command, t_ns)
        if command.model is not None:
            self._sizer.add_model(command.peer, command.model)

    def start_at(self, k: int) -> None:
        """Makes `k` the first tick of an arm that joins a running session.

        Must be called before any tick is computed. The arm is at rest in its start pose, and no
        sample from another arm is in use or waiting. The delay and loss models of the links are
        advanced past all samples that the other arms have sent up to tick k - 1.

        Args:
            k: First tick.
        """
        links_may_be_ahead = k <= self._site["first"]
        if links_may_be_ahead:
            # The links may be ahead of tick k, so start them from scratch.
            self.restore_links(k, [None] * len(self.peers), ())
        self._site["first"] = k
        for n, link in enumerate(self._links):
            peer_hz = int(link["rate_hz"])
            last_sample = (k - 1) * peer_hz // self.rate_hz
            if last_sample >= 0:
                # The result is not needed. The call advances the link's random models to this
                # sample.
                find_release(n, last_sample, self._arrays)
        # Copies of samples that were sent before the site joined are not counted.
        self._links["copies"] = 0

    def step(self, tick: TickInput) -> TickRecord:
        """Computes one period of the control loop: from messages to torque and motion.

        Time advances only through this method, in live runs as well as in simulations and
        replays. The same input therefore always produces the same results.

        Args:
            tick: Number and inputs of the period. The number must follow that of the previous
                call.

        Returns:
            The record of the period: its inputs and results.

        Raises:
            ValueError: There are more than MAX_ARRIVALS arrivals, or too many planned changes.
            LawFailed: A user's control law failed. Under the rule `glide`, see `session_life`,
                the site enters the mode FAULT instead.
        """
        t_ns = tick.k * NS_PER_S // self.rate_hz
        count = len(tick.arrivals)
        for command in tick.commands:
            self.apply_change(command, t_ns)
        packed_bytes = self._pack(tick.k, tick.arrivals)

        bodies: Sequence[float] = ()
        if tick.measured is not None and self._external:
            bodies = tick.measured.bodies
            self._write_measurement(tick.measured)
        hand = self._apply_hand(tick.hand)
        law_memory = self._compute_tick(tick.k, t_ns, count)

        row = self._buffers.record.tolist()
        mode = self._mode.item()
        memory: list[float] = []
        if self._remembers or mode not in (_RUN, _DIVERGED):
            memory = self._held_memory() + law_memory
        q, qd, q_des, qd_des, tau, tau_x, theta_hat = [
            row[column] for column in self._state_columns
        ]
        x, xd, wrench = [row[column] for column in self._shared_columns] or _NO_SHARED
        # Positional arguments, because a call that names the twenty fields takes 3 microseconds
        # longer.
        return TickRecord(
            tick.k,
            t_ns,
            _MODES[mode],
            q,
            qd,
            q_des,
            qd_des,
            tau,
            tau_x,
            theta_hat,
            self._used.tolist(),
            self._compute_crc(packed_bytes, count),
            [command.text for command in tick.commands],
            memory,
            x,
            xd,
            wrench,
            self._sent.tolist() or (),
            hand,
            bodies,
        )

    def _compute_tick(self, k: int, t_ns: int, count: int) -> list[float]:
        """Computes a complete control period, from received messages to the results and motion.

        Without a user's control law, one compiled function computes all eight stages (listed in
        `kernel`). A user's law is called between two compiled functions, one for the stages
        before the torque and one for those after it.

        Args:
            k: Current tick.
            t_ns: Nominal time of the tick, ns since the start of the session.
            count: Number of arrivals in the buffers.

        Returns:
            The memory of the user's law. Empty if there is no such law.
        """
        if self._law is None:
            if self._tick is None:
                # Compile at the first tick, for arguments with the types of three integers.
                self._tick = bind_leaf(site_tick, 0, 0, 0, *self._tick_arrays)
            self._tick(k, t_ns, count, *self._tick_arrays)
            return []

        arrays = self._arrays
        # Stages 1 to 5: accept, release, reference, errors, estimate.
        self._sense(k, t_ns, count, arrays, self._buffers)
        # Stage 6: torque.
        memory = self._compute_law(k, t_ns)
        # Stages 7 and 8: emit, advance. The limits of the torque come first.
        self._act(
            k,
            t_ns,
            arrays.site,
            arrays.actors,
            arrays.table,
            arrays.chain,
            self._buffers.record,
        )
        return memory

    def _write_measurement(self, measured: PlantState) -> None:
        """Stores the measured motion of a real arm, in place of a simulated motion.

        Args:
            measured: Joint angles, rad, joint velocities, rad/s, and the external torque tau_x,
                N m. An empty torque is treated as zero.
        """
        s: Row = self._site[0]
        s.q = measured.q
        s.qd = measured.qd
        # The record uses the sign of Eq. (8); the row contains the torque ON the arm.
        s.sensed = [-torque for torque in measured.tau_x] or 0.0

    def _compute_law(self, k: int, t_ns: int) -> list[float]:
        """Computes the torque of a control period with a user-written control law.

        The law writes the torque to the state of the site. The return value is the memory of
        the law, which it keeps from one period to the next.

        The rule `glide` brings the arm to rest when something fails. Under this rule, a law
        that fails produces NaN as its torque. `act_stages` then enters the mode FAULT with the
        reason NOT_FINITE. The law is not called again until the fault is reset, when it
        continues with the memory that it had before the failure.

        Args:
            k: Current tick.
            t_ns: Nominal time of the tick, ns since the start of the session.

        Raises:
            LawFailed: The law failed, and the site is not under the rule `glide`.
        """
        assert self._law is not None
        s: Row = self._site[0]
        if not self._glides:
            return self._law.compute(k, t_ns)

        has_failed_before = s.mode == Mode.FAULT and s.reason == LifeReason.NOT_FINITE
        if has_failed_before:
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
        """Largest permitted joint speeds, rad/s or m/s, from the key `qd_limit_rad_s`."""
        limits: list[float] = self._site[0]["qd_limit"].tolist()
        return limits

    @property
    def mode(self) -> Mode:
        """Mode of the arm in the last control period, for example RUN if it follows others."""
        return _MODES[self._mode.item()]

    @property
    def life_reason(self) -> LifeReason:
        """Reason why the arm last changed its mode, for example that another arm fell silent.

        Reasons exist only under the rule `glide`, see `session_life`.
        """
        return LifeReason(self._reason.item())

    @property
    def is_braked(self) -> bool:
        """True if brakes hold the arm because its dead-man switch was released."""
        return self.mode is Mode.STOPPED and self.life_reason in RELEASE_REASONS

    @property
    def awaits_switch(self) -> bool:
        """True if the arm is stopped only until somebody holds its dead-man switch again."""
        return self.mode is Mode.STOPPED and self.life_reason is LifeReason.RELEASED

    @property
    def is_too_far(self) -> bool:
        """True if the arm does not follow its peers because they are too far away."""
        return self.life_reason is LifeReason.ALIGN_LIMIT

    @property
    def arrays(self) -> SiteArrays:
        """Arrays with the current state of the site, which callers must not modify."""
        return self._arrays

    @property
    def parts(self) -> "_TickParts":
        """Internal data that `recorded_ticks` uses to compute many control periods at once."""
        return _TickParts(
            buffers=self._buffers,
            calendar_sizer=self._sizer,
            has_user_law=self._law is not None,
            reflects=self._reflects,
            keeps_forces=self._keeps_forces,
            glides=self._glides,
            degrades=self._degrades,
            hand_index=self._hand_index,
        )

    @property
    def q(self) -> list[float]:
        """Joint angles at the start of the next control period, one per joint, rad.

        This differs from the last record, which contains the joint angles at the start of its
        own period.
        """
        joints = self.layout.joints
        angles: list[float] = self._site[0]["q"][:joints].tolist()
        return angles

    def _apply_hand(self, vector: Sequence[float]) -> Sequence[float]:
        """Applies the pull of a person or program on the arm in this control period.

        Args:
            vector: The action in the form of `HandInForce`: grip firmness, target, and velocity
                of the target. Empty if nobody holds the arm.

        Returns:
            The action for the record of the tick. Empty if the site has no live hand.
        """
        if self._hand is None:
            return ()
        # These are views of the row, so assigning to them changes the row.
        grip, target, target_ahead = self._hand
        action = list(vector) or HandInForce.list_empty(len(target))
        hand = HandInForce.read(action)
        grip[0] = hand.grip
        target[:] = hand.target
        # The target one second later: its position plus its velocity times 1 s.
        motion = zip(hand.target, hand.rate, strict=True)
        target_ahead[:] = [position + velocity for position, velocity in motion]
        return action

    def _compute_crc(self, packed_bytes: int, arrivals: int) -> int:
        """Returns the checksum of the samples that arrived, for the log.

        The checksum is compared when the log is verified. It only covers what this site uses:
        the sender, tick and motion of each sample, then the forces if the site reflects forces
        to its user, then the values sent by the other control laws if this site's law reads
        such values.

        Args:
            packed_bytes: Number of bytes of the packed arrivals: peers, ticks and motions.
            arrivals: Number of arrivals.
        """
        crc = zlib.crc32(self._arrival_bytes[:packed_bytes])
        if self._reflects:
            bytes_per_float = 8
            force_bytes = arrivals * bytes_per_float * self.layout.shared
            crc = zlib.crc32(self._force_bytes[:force_bytes], crc)
        if self._received_counts:
            peers = self._buffers.arrivals["peer"][:arrivals].tolist()
            # Row n of `sent` belongs to arrival n. The rows are longer than what a peer sends.
            for n, peer in enumerate(peers):
                count = self._received_counts[peer]
                sent = self._buffers.sent[n, :count]
                crc = zlib.crc32(sent.data, crc)
        return crc

    def _held_memory(self) -> list[float]:
        """Lists the state variables that the next tick needs and no other field records.

        The field `mem` of a record stores them, which makes it possible to continue a run from
        any tick. Only a site under the rule `glide`, which brings arms to rest, has more than
        the first two:

        - `q_held`: the held reference, or the initial value of an offset that decays to zero,
        - `return_from_ns`: the time at which the current rest, return or run started, ns,
        - `qd_held`: the rate of change of `q_held`,
        - `reason`: why the mode last changed, a `LifeReason`,
        - `used_ns`: for each peer, the time at which its last sample came into use, ns,
        - `tau_held`: the torque of each joint that carries a constant load at rest, N m,
        - `q_rest`, `qd_rest`: the reference that brings the joints to rest, only in task space,
        - `gone`: the state of each peer, only if the site continues without lost peers.

        `restore_state` reads the same values in the same order.
        """
        return_from_ns = float(self._return_from_ns.item())
        memory = [*self._q_held.tolist(), return_from_ns]
        if not self._glides:
            return memory

        memory += self._qd_held.tolist()
        memory.append(float(self._reason.item()))
        memory += map(float, self._used_ns.tolist())
        memory += self._tau_held.tolist()
        if self.layout.task:
            memory += self._q_rest.tolist()
            memory += self._qd_rest.tolist()
        if self._degrades:
            memory += self._gone.tolist()
        return memory

    def counts(self) -> tuple[LinkCounts, ...]:
        """Returns how many messages arrived, were late or were lost, for each network link.

        The links are in scenario order. See `LinkCounts` for the individual counts.
        """
        counts = []
        for link in self._links:
            numbers = [int(link[field]) for field in LinkCounts._fields]
            counts.append(LinkCounts(*numbers))
        return tuple(counts)

    def release_tick(self, peer: int, tick: int) -> int | None:
        """Finds the control period of this arm in which a peer's sample is first used.

        Args:
            peer: Index of the peer.
            tick: Tick in which the peer sent the sample.

        Returns:
            The tick of this site if the sample arrives in time. None if the link drops the
            sample, or if the sample is so old that its delivery time is no longer stored.
        """
        release = int(find_release(peer, tick, self._arrays))
        return None if release == LOST else release

    def is_measured(self, peer: int) -> bool:
        """Returns True if the only delay of a link is that of the real network.

        Args:
            peer: Index of the sender at the other end of the link.
        """
        link: Row = self._links[peer]
        model: Row = self._arrays.models[peer, link.model]
        return bool(model["kind"] == DelayKind.MEASURED)

    def peer_rate_hz(self, peer: int) -> int:
        """Returns the rate of a peer's control loop, Hz, which may differ from this arm's.

        Args:
            peer: Index of the peer, in scenario order.
        """
        return int(self._links[peer]["rate_hz"])

    def restore_state(self, before: TickRecord, last: TickRecord) -> None:
        """Restores the state of the arm and its control law from the records of a run.

        After a subsequent call of `restore_links`, `step` continues the run.

        The field `mem` of a record contains the state variables of the site and its law that no
        other field contains. For m coordinates shared between sites, these are

        - the held reference (m values), and the time since which it has been held, ns,
        - under the rule `glide` (where an arm comes to rest while a peer is silent), the
          additional values read by `_restore_life`,
        - the memory of the user's law, if there is one.

        `mem` is empty if there is nothing to store.

        Args:
            before: Record of the control period before `last`. If `last` is the first record,
                any record can be passed.
            last: Record of the last control period before those that `step` will compute.
        """
        s: Row = self._site[0]
        shared = self.layout.shared
        s.mode = int(last.mode)
        s.q = last.q
        s.qd = last.qd
        s.theta_hat = last.theta_hat
        s.q_des = last.q_des
        s.qd_des = last.qd_des
        s.tau = last.tau
        # `resume_stages` extrapolates the torque during the period of `last` from both torques.
        s.tau_before = before.tau
        if last.mem:
            s.q_held = last.mem[:shared]
            s.return_from_ns = int(last.mem[shared])
        law_memory = last.mem[shared + 1 :]
        if self._glides and law_memory:
            law_memory = self._restore_life(law_memory)
        self._sent[:] = last.ch or 0.0  # `ch` is empty if the law sends no values
        self._apply_hand(last.hand)
        if self._law is not None:
            self._law.restore(law_memory)
            self._law_memory = list(law_memory)
        # Compute what no record contains: errors, external torques, and the motion after
        # `last`.
        resume_stages(last.tick, self._arrays)

    def _restore_life(self, memory: list[float]) -> list[float]:
        """Restores the memory of the rule `glide` from the field `mem` of a record.

        Under this rule, an arm comes to rest while a peer is silent, see `session_life`. The
        values are read in the order in which `_held_memory` writes them:

        - `qd_held`: the rate of change of the held reference, one value per shared coordinate,
        - `reason`: why the mode last changed, a `LifeReason`,
        - `used_ns`: the time at which the last sample of a peer came into use, per peer, ns,
        - `tau_held`: the torque that carries a constant load at rest, per joint, N m,
        - `q_rest` and `qd_rest`, only in task space: the reference that brings the joints to
          rest, two values per joint,
        - `gone`, only if the site continues without lost peers: the state of each peer.

        Args:
            memory: Contents of `mem`, after the held reference and the time since which it has
                been held.

        Returns:
            The remaining values, which belong to the user's law.
        """
        s: Row = self._site[0]
        shared = self.layout.shared
        peers = len(self.peers)
        joints = self.layout.joints
        s.qd_held = memory[:shared]
        s.reason = int(memory[shared])
        remaining = memory[shared + 1 :]

        # Each value is removed from `remaining` once it has been restored.
        self._links["used_ns"] = remaining[:peers]
        remaining = remaining[peers:]
        s.tau_held = remaining[:joints]
        remaining = remaining[joints:]
        if self.layout.task:
            s.q_rest = remaining[:joints]
            s.qd_rest = remaining[joints : 2 * joints]
            remaining = remaining[2 * joints :]
        if self._degrades:
            self._links["gone"] = remaining[:peers]
            remaining = remaining[peers:]
        # Orders and missed ticks are inputs of the tick that applies them, so none are pending
        # here.
        s.order = 0
        s.skipped = 0
        return remaining

    def restore_links(
        self, k: int, in_use: Sequence[Arrival | None], waiting: Sequence[Arrival]
    ) -> None:
        """Restores the state of the network links, to continue a recorded run at tick k.

        The state of random delay and loss models is not recorded. It is recomputed from the
        start of the run, which yields the same random numbers.

        Args:
            k: Next tick.
            in_use: For each peer, the newest sample that has been used, or None if there was
                none.
            waiting: Samples that have arrived, but whose simulated delay has not passed.

        Raises:
            ValueError: More than MAX_ARRIVALS samples are waiting.
        """
        self._arrays.calendars["tick"] = -1
        self._sizer.clear()
        link: Row
        for n, (link, start_pose, sample) in enumerate(
            zip(self._links, self._start_poses, in_use, strict=True)
        ):
            link.scheduled = -1
            link.model = 0
            link.due_before = 0
            if sample is None:
                link.used = -1
                link.q = start_pose
                link.qd = 0.0
                link.tau_x = 0.0
            else:
                link.used = sample.tick
                link.q = sample.q
                link.qd = sample.qd
                link.tau_x = sample.tau_x or 0.0
            self._restore_received(n, sample)

        self._pack(k, waiting)
        accept_stage(k, len(waiting), self._arrays, self._buffers)

    def _restore_received(self, peer: int, sample: Arrival | None) -> None:
        """Restores the values that a peer's control law sent with the sample in use.

        User-written control laws can send values to each other in addition to the motion of the
        arms. These are in the field `ch` of a sample. The law of this site reads the values in
        its own order: for each value that it reads, the array `columns` contains the index in
        `ch`, or -1 if the peer's law does not send this value, which is then 0.

        Args:
            peer: Index of the peer.
            sample: The sample in use. None before the first sample.
        """
        channel = self._arrays.channel
        if channel is None:
            return  # the law of this site is built in, and reads no such numbers
        if sample is None or not len(sample.ch):
            channel.received[peer] = 0.0
            return
        # The index -1 selects the last element, the appended zero.
        sent_and_zero = np.append(sample.ch, 0.0)
        channel.received[peer] = sent_and_zero[channel.columns[peer]]

    def _pack(self, k: int, arrivals: Sequence[Arrival]) -> int:
        """Writes the samples that arrived before a tick to the input buffers of the tick.

        The buffers have three parts:

        - `arrivals`: peer, tick and motion of each sample,
        - `forces`: the external torques of the senders, if this site uses them,
        - `sent`: the values sent by the senders' laws, if this site's law reads such values.

        The tick later moves the samples to the calendars, the ring buffers in which they wait
        for their simulated delay to pass. If a sample does not fit there, the calendars are
        replaced with larger ones.

        Args:
            k: Current tick.
            arrivals: Samples that arrived since the previous tick.

        Returns:
            The number of bytes written to `arrivals`.

        Raises:
            ValueError: There are more than MAX_ARRIVALS arrivals.
        """
        if len(arrivals) > MAX_ARRIVALS:
            raise ValueError(
                f"a tick can process at most {MAX_ARRIVALS} arrivals, but has {len(arrivals)}"
            )
        packed_bytes = 0
        # For each peer the newest sample that is known to fit; `make_room` updates the list.
        newest_fitting = self._sizer.newest
        for peer, tick, q, qd, *_ in arrivals:
            if tick > newest_fitting[peer]:
                self._arrays = self._sizer.make_room(self._arrays, k, peer, tick)
                # The arguments of the compiled tick contain the calendars.
                self._tick_arrays = (*self._arrays, *self._buffers)
            self._pack_arrival(self._arrival_bytes, packed_bytes, peer, tick, *q, *qd)
            packed_bytes += self._arrival_size
        # A sample without forces or sent values has an empty vector, which is read as zeros.
        if self._keeps_forces:
            for n, arrival in enumerate(arrivals):
                self._buffers.forces[n] = arrival.tau_x or 0.0
        if self._received_counts:
            for n, arrival in enumerate(arrivals):
                count = self._received_counts[arrival.peer]
                self._buffers.sent[n, :count] = arrival.ch or 0.0
        return packed_bytes
