"""Defines the record of one tick, and the sample that an arm sends to the others.

The kernel computes the record of a tick, the network sends it, and the log stores it. All of
them use the types of this module, so programs that only send or store records need neither the
kernel nor its compiler.

Invariant:
    - This module imports nothing from the program.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

NS_PER_S = 1_000_000_000
JOINTS = 2
"""Number of joints of the planar two-link arm."""
PARAMETERS = 5
"""Number of dynamic parameters of the planar two-link arm."""
MAX_JOINTS = 12
"""Largest number of joints of an arm."""
MAX_LAW_MEMORY = 1024
"""Largest number of values in a law's memory, which is part of each record."""


class Mode(IntEnum):
    """Mode of a site in one tick.

    RUN: the arm follows the other arms. If no samples arrive from one of them, the mode becomes
    HOLD (the arm keeps its last reference) or BRAKE (the arm keeps its pose). When samples
    arrive again, it becomes RETURN (the arm moves smoothly back to the others), and then RUN.
    DIVERGED: a joint was too fast, or a value was not finite. This mode is final.

    The rule `glide` (see `core.life.session_life`) has additional modes, in all of which the
    arm comes to rest. WAITING: samples have not yet arrived from all other arms. FAULT: for
    example, a limit was exceeded; this mode replaces DIVERGED. STOPPED: the arm was stopped,
    for example by a command.
    """

    RUN = 1
    DIVERGED = 2
    HOLD = 3
    BRAKE = 4
    RETURN = 5
    WAITING = 6
    FAULT = 7
    STOPPED = 8


class Arrival(NamedTuple):
    """A sample that arrived at a site: the state that a peer sent in one tick.

    Each peer sends one sample per tick.

    Attributes:
        peer: Index of the peer.
        tick: Tick of the peer in which the sample was sent.
        q: Joint angles of the peer, rad.
        qd: Joint velocities of the peer, rad/s.
        latency_us: Measured network latency, us. Recorded for information only.
        tau_x: External torque of the peer, N m, for control laws that reflect force. The torque
            ON the peer's arm is minus this value.
        ch: Additional values sent by the control law of the peer. See `core.plug.law_channel`.
    """

    peer: int
    tick: int
    q: Sequence[float]
    qd: Sequence[float]
    latency_us: int = 0
    tau_x: Sequence[float] = ()
    ch: Sequence[float] = ()


class TickRecord(NamedTuple):
    """State of a site at the start of a tick, and the results computed from it.

    The state at the end of the tick is part of the next record.

    Attributes:
        tick: Number k of the tick.
        t_ns: Nominal time, ns since the start of the session.
        mode: The site's mode.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        q_des: Reference q_id, Eq. (6), rad.
        qd_des: Derivative of q_des, rad/s.
        tau: Control torque, Eq. (13), N m.
        tau_x: External torque with the sign of Eq. (8), N m; the torque ON the arm is its
            negative.
        theta_hat: Parameter estimate.
        used: Tick of the sample in use from each peer, in scenario order; -1 before the first
            sample.
        rx_crc: CRC-32 of the arrivals of this tick, as received by the step. A modified input
            in the log is detected by a mismatch of this checksum in the tick of the input. Each
            arrival is encoded in little-endian order (peer i64, tick i64, q f64s, qd f64s),
            followed by its tau_x if the law reflects force.
        cmd: Changes applied in this tick, as JSON strings.
        mem: State of the site that no other field contains. Empty in RUN and DIVERGED. In other
            modes, the held pose, rad, and the time at which the return began, ns since the
            start of the session, or 0 before the return. For a site with a user's law, these
            values are present in every mode, followed by the memory of the law. Under the rule
            `glide`, the state of `core.life.session_life` in every mode (see
            `Layout.count_life_memory`).
        x: Pose of the end effector that is shared in task space: position, m, and orientation.
            Empty in joint space.
        xd: Derivative of x, m/s and rad/s.
        wrench: tau_x expressed at the end effector, N and N m.
        ch: Values sent by the site's law. See `core.plug.law_channel`.
        hand: Action of a live hand (a person or program that moves the arm during the run) in
            this tick. See `core.life.live_hand`. Empty if there is no live hand.
        bodies: Poses of other bodies in the scene, seven values each: x, y, z in the arm's base
            frame, m, and the unit quaternion w, x, y, z. Empty if there are none.
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
    cmd: list[str]
    mem: list[float]
    x: Sequence[float] = ()
    xd: Sequence[float] = ()
    wrench: Sequence[float] = ()
    ch: Sequence[float] = ()
    hand: Sequence[float] = ()
    bodies: Sequence[float] = ()

    def shared(self) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        """Returns the motion and external torque that an arm sends to the others in one tick.

        If the arm is controlled in task space, the values describe its end effector, otherwise
        its joints.

        Returns:
            The position, the velocity and the external torque, each with one entry per
            coordinate.
        """
        if self.x:
            return self.x, self.xd, self.wrench
        return self.q, self.qd, self.tau_x


class Layout(NamedTuple):
    """Lengths of the vectors of an arm and its control law, for example 2 joint angles.

    These lengths determine the layout of all arrays and log records of the arm.

    Attributes:
        joints: Number of joints of the arm.
        shared: Number of coordinates that the arms send to each other.
        parameters: Number of dynamic parameters of the arm.
        chain: True if the arm is a chain of joints. False for the planar two-link arm.
        task: True if the coordinates are the pose of the end effector. False if they are joint
            angles.
        sent: Number of values that the control law sends to other arms in each tick.
        hand: Number of values that describe a live hand (a person or program that moves the arm
            during the run), see `core.life.live_hand`. 0 if there is no live hand.
        bodies: Number of values in the poses of other bodies in the scene, see
            `TickRecord.bodies`.
    """

    joints: int = JOINTS
    shared: int = JOINTS
    parameters: int = PARAMETERS
    chain: bool = False
    task: bool = False
    sent: int = 0
    hand: int = 0
    bodies: int = 0

    def axes(self) -> dict[str, int]:
        """Returns the sizes of the named dimensions of state arrays, for example "joints": 2.

        The names are "joints", "shared" and "parameters" (see `core.step.row_fields`).
        """
        return {"joints": self.joints, "shared": self.shared, "parameters": self.parameters}

    def lengths(self) -> dict[str, int]:
        """Returns the lengths of the vectors of a record, keyed by name, in record order.

        Vectors that the arm does not have are omitted.
        """
        lengths = {
            "q": self.joints,
            "qd": self.joints,
            "q_des": self.shared,
            "qd_des": self.shared,
            "tau": self.joints,
            "tau_x": self.joints,
            "theta_hat": self.parameters,
        }
        if self.task:
            lengths |= {"x": self.shared, "xd": self.shared, "wrench": self.shared}
        optional = {"ch": self.sent, "hand": self.hand, "bodies": self.bodies}
        lengths |= {name: count for name, count in optional.items() if count}
        return lengths

    def columns(self) -> dict[str, slice]:
        """Returns the columns of each vector in a record, for example "q": slice(0, 2).

        A record is the row of floating-point numbers computed by a site in one tick.

        Returns:
            A mapping from vector name to slice, excluding vectors that are inputs of the tick.
        """
        columns = {}
        first = 0
        for name, length in self.lengths().items():
            is_input = name in ("hand", "bodies")
            if not is_input:
                columns[name] = slice(first, first + length)
                first += length
        return columns

    def count_life_memory(self, peers: int, *, degrades: bool = False) -> int:
        """Returns the number of recorded values that contain the state of the rule `glide`.

        Under this rule, an arm comes to rest while another arm is silent (see
        `core.life.session_life`). The values are needed to resume a run while the arm is at
        rest, and are stored at the start of the field `mem`:

        - values stored for every arm, for example the time of the last sample from each other
          arm,
        - in task space, the reference that brings the joints to rest (`rest_columns`),
        - if the arm may continue without a lost arm, one flag per other arm that states whether
          it is lost.

        Args:
            peers: Number of sites from which this site receives data.
            degrades: True if the site continues without a lost site.
        """
        end_of_reference: int = self.rest_columns(peers).stop
        lost_peer_values = peers * degrades  # zero if `degrades` is False
        return end_of_reference + lost_peer_values

    def rest_columns(self, peers: int) -> slice:
        """Returns the slice of `mem` that holds the reference for bringing the joints to rest.

        The field `mem` of a record contains the values needed to resume a run. For a site with
        n joints, m shared coordinates and P peers, it starts with the values that `Site` stores
        under the rule `glide`:

            q_held (m), return_from_ns (1), qd_held (m), reason (1), used_ns (P), tau_held (n),
            q_rest (n), qd_rest (n)                                       only in task space

        `q_rest` and `qd_rest` are the position and velocity of the reference for each joint. In
        joint space, they are stored in `q_held` and `qd_held` while the arm rests.

        Args:
            peers: Number P of sites from which this site receives data.

        Returns:
            The slice of `q_rest` and `qd_rest`. Empty in joint space.
        """
        held_and_start = self.shared + 1  # q_held and return_from_ns
        rate_and_reason = self.shared + 1  # qd_held and reason
        first = held_and_start + rate_and_reason + peers + self.joints
        length = 2 * self.joints * self.task  # zero in joint space, where `task` is False
        return slice(first, first + length)

    def list_lost_peers(self, mem: Sequence[float], peers: Sequence[str]) -> list[str]:
        """Returns the names of the arms that were lost while this arm continued without them.

        The names are decoded from a record in this arm's log.

        Args:
            mem: Field `mem` of the record, the state that the site keeps between ticks.
            peers: Names of the peers that this arm follows, in scenario order.
        """
        end = self.count_life_memory(len(peers), degrades=True)
        # One number per peer: 0 if the peer is present.
        states = mem[end - len(peers) : end]
        # Under another rule, the memory is shorter, and no peer counts as lost.
        return [peer for peer, state in zip(peers, states, strict=False) if state]

    @property
    def floats(self) -> int:
        """Number of floats that a site computes in one tick.

        These floats form a record of the log. Inputs of the tick are not counted.
        """
        shared_vectors = 5 if self.task else 2
        return 4 * self.joints + shared_vectors * self.shared + self.parameters + self.sent
