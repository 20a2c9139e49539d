"""Defines the messages that the members of a session publish and that a log stores.

In every tick, a site publishes a `PeerSample` for the other sites and a `State` for the
recorder. It publishes `LinkStats` ten times per second, and an `Event` when something happens.
A recorder publishes `RecorderStats` and events. Every member replies to queries with an `Info`.

The classes serve as the schema of the messages. A log contains their JSON Schema, including
their docstrings.

Invariant:
    - A single definition validates a message, yields its JSON Schema and documents its format.
    - The unit of each quantity is part of the field's name or of the schema (`x-unit`). All
      units are SI units and radians.
"""

import ast
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta

from ..records import MAX_JOINTS, MAX_LAW_MEMORY, Layout, Mode, TickRecord

VERSION = 4
"""Schema version of sent messages. Messages with other versions are not accepted."""
READABLE = (1, 2, 3, 4)
"""Schema versions that can be read from files: all versions that were released."""
SENT_TIME_SINCE = 2
"""First schema version whose records contain the time at which they were sent."""

U64 = Annotated[int, Meta(ge=0)]
"""An integer from 0 to 2^64 - 1, such as the boot of a process."""
TickNumber = Annotated[int, Meta(ge=0, lt=2**40)]
"""Number of a tick, or another count of the same magnitude."""
Instant = Annotated[int, Meta(ge=-(2**59), lt=2**59)]
"""A reading of a clock in ns, within eighteen years of 0.

The limit ensures that sums and differences of a few readings still fit into an integer that a
message can contain.
"""
Stamp = Annotated[list[Instant], Meta(min_length=3, max_length=3)]
"""Three integers that describe the arrival of a sample, see `State.rx` and `State.echo`."""
MOST_PEERS = 32
"""Maximum number of sites in a scenario."""


class ModeMeaning(NamedTuple):
    """Meaning of a site's mode, such as "run" or "stopped", for programs that read records.

    Attributes:
        mode: The mode.
        does: Phrase that describes the site in the present tense, as in "m1 follows".
        did: Phrase that describes the site in the past tense, as in "m1 followed".
        follows: True if the arm follows the states of the peers.
        rests: True if the site brings its arm to rest in this mode, for example because the
            connection to a peer is interrupted. It then ignores the samples of its peers, and
            adds a braking torque to the torque of the control law.
        halted: True if the site leaves this mode only at the request of a user.
    """

    mode: Mode
    does: str
    did: str
    follows: bool = False
    rests: bool = False
    halted: bool = False


MODES = {
    "run": ModeMeaning(Mode.RUN, "follows", "followed", follows=True),
    "hold": ModeMeaning(Mode.HOLD, "holds", "held", rests=True),
    "brake": ModeMeaning(Mode.BRAKE, "brakes", "braked"),
    "return": ModeMeaning(Mode.RETURN, "returns", "returned"),
    "waiting": ModeMeaning(Mode.WAITING, "waits", "waited", rests=True),
    "fault": ModeMeaning(Mode.FAULT, "is in fault", "in fault", rests=True, halted=True),
    "stopped": ModeMeaning(Mode.STOPPED, "is stopped", "stopped", rests=True, halted=True),
    "diverged": ModeMeaning(Mode.DIVERGED, "diverges", "diverged", follows=True),
}
"""Mapping from the name of each mode in records and messages to its meaning."""
MODE_WORDS = {meaning.mode: word for word, meaning in MODES.items()}
"""Name of each mode in records and messages."""
HALTED_MODES = tuple(word for word, meaning in MODES.items() if meaning.halted)
"""Names of the modes that a site leaves only on request."""
RESTING_MODES = tuple(word for word, meaning in MODES.items() if meaning.rests)
"""Names of the modes in which an arm comes to rest."""


def _unit(unit: str, text: str, **limits: Any) -> Meta:
    """Annotates a field with its unit, its description and its limits."""
    return Meta(description=text, extra_json_schema={"x-unit": unit}, **limits)


Angles = Annotated[list[float], _unit("rad", "joint angles")]
Speeds = Annotated[list[float], _unit("rad/s", "joint velocities")]
Torques = Annotated[list[float], _unit("N m", "joint torques")]


# The docstrings of `State`, `LinkStats`, `Event` and `RecorderStats` are part of the schemas that
# logs contain, so they stay byte for byte as they were published.
class State(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The complete record of one tick of one site; what each vector means stands at `core.tick.Output`.

    Attributes:
        v: version of this schema.
        site: who sends.
        boot: the sender's process start, random.
        tick: its tick.
        t_ns: nominal time, ns since the session's epoch.
        mode: "run", "hold", "brake", "return", "waiting", "fault", "stopped" or "diverged", see
            `core.tick.Mode`.
        q: joint angles.
        qd: joint velocities.
        q_des: reference, Eq. (6).
        qd_des: its derivative.
        tau: control torque, Eq. (13).
        tau_x: exogenous torque as Eq. (8) subtracts it.
        theta_hat: estimate of theta, Eq. (24).
        used: per peer the tick of the sample in use, -1 before the first.
        rx: arrivals in the order accepted: index of the peer among the sender's peers, its tick, its one-way
            delay in us by the offset in force (before version 2: the age of its nominal stamp).
        rx_crc: CRC-32 of those arrivals as the step took them in.
        cmd: commands taken in, each the JSON of a `scenario.timeline.Change`.
        mem: what the site remembers besides, see `core.tick.Output`.
        late_us: wake-up minus deadline of this tick.
        busy_us: computing time of the tick before.
        sent_ns: when it was sent: the sender's clock as it runs, never slewed, ns since the epoch on it.
        echo: of each peer the newest sample that this tick took in: index of the peer, its tick, and its
            arrival on the same clock as `sent_ns`.
        x: in task space the coordinates that the sites exchange; in joint space these are left out.
        xd: their derivatives.
        wrench: exogenous torque in those coordinates.
        ch: what the site's law sends besides, see `core.plug.law_channel`; left out if it sends nothing.
        hand: what somebody who holds the arm does: grip from 0 to 1, number of the newest message (-1
            without), who holds it (0: nobody), target, its velocity, see `core.life.live_hand`; left out without
            a live hand.
        bodies: poses of the bodies of its plant, seven numbers each: x, y, z in the arm's base frame, m, and
            the unit quaternion w, x, y, z; left out without any.
    """

    v: int
    site: str
    boot: U64
    tick: TickNumber
    t_ns: Annotated[int, _unit("ns", "nominal time since the session's epoch")]
    mode: str
    q: Angles
    qd: Speeds
    q_des: Angles
    qd_des: Speeds
    tau: Torques
    tau_x: Torques
    theta_hat: list[float]
    used: dict[str, int]
    rx: list[Stamp]
    rx_crc: U64
    cmd: list[str]
    mem: Annotated[list[float], Meta(max_length=MAX_JOINTS + 1 + MAX_LAW_MEMORY)]
    late_us: Annotated[int, _unit("us", "wake-up minus deadline")]
    busy_us: Annotated[int, _unit("us", "computing time of the tick before")]
    sent_ns: Annotated[
        Instant, _unit("ns", "when it was sent, on the sender's clock since the epoch")
    ] = 0
    echo: list[Stamp] = []
    x: list[float] = []
    xd: list[float] = []
    wrench: list[float] = []
    ch: list[float] = []
    hand: list[float] = []
    bodies: list[float] = []

    def to_tick_record(self, peers: tuple[str, ...]) -> TickRecord:
        """Converts the record to the object that `Site.step` returns for the same tick.

        The result can be compared with a repeated execution of the tick. Most fields are the
        same in both forms and are explained in `TickRecord`. Three fields differ:

        - The mode is a word in the log. An unknown word, as in a log from another version of
          the program, becomes "diverged".
        - `used` (the tick of the newest sample in use) is listed in the log by the name of the
          peer, and in the object by the index of the peer. -1 means that there is no sample.
        - `mem` (the memory of the site) is copied only if it is complete, and is empty
          otherwise.

        Args:
            peers: Names of the other sites, in scenario order.
        """
        mode = MODES.get(self.mode, MODES["diverged"]).mode
        # The memory begins with a pose, which has as many numbers as `q_des`. A memory without
        # further numbers is not complete.
        has_complete_memory = len(self.mem) > len(self.q_des)
        mem = self.mem if has_complete_memory else []
        return TickRecord(
            tick=self.tick,
            t_ns=self.t_ns,
            mode=mode,
            q=self.q,
            qd=self.qd,
            q_des=self.q_des,
            qd_des=self.qd_des,
            tau=self.tau,
            tau_x=self.tau_x,
            theta_hat=self.theta_hat,
            used=[self.used.get(peer, -1) for peer in peers],
            rx_crc=self.rx_crc,
            cmd=self.cmd,
            mem=mem,
            x=self.x,
            xd=self.xd,
            wrench=self.wrench,
            ch=self.ch,
            hand=self.hand,
            bodies=self.bodies,
        )


class PeerSample(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The state of an arm that its site sends to the peers in every tick.

    It contains the part of the tick's `State` that peers need, with exactly the same values. If
    the sites exchange positions in task space, `q`, `qd` and `tau_x` contain `x`, `xd` and
    `wrench` of the `State`. `ch` contains what the control law sends to the laws of the peers:
    one part for all peers, and one part for each peer.
    """

    v: int
    site: str
    boot: U64
    tick: TickNumber
    q: list[float]
    qd: list[float]
    tau_x: list[float]
    sent_ns: Instant = 0
    echo: Annotated[list[Stamp], Meta(max_length=MOST_PEERS)] = []
    ch: list[float] = []


class LinkStats(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Statistics of a site's loop and of its links, ten times a second.

    Attributes:
        v: version of this schema.
        site: who sends.
        boot: the sender's process start.
        tick: the tick after which they were taken.
        t_ns: nominal time of that tick, ns since the epoch.
        mode: the site's mode.
        age_us: per peer, now minus the stamp of the sample in use; -1 before the first.
        accepted: per peer, samples taken in since the start.
        late: per peer, those that came after they were due.
        duplicate: per peer, those that came twice.
        refused: per peer, those whose stamp was out of range.
        lost: per peer, those that the link's model lost.
        superseded: per peer, those never used because a newer one was released before or with them.
        copies: per peer, duplicates that the link's model made.
        dropped: messages that were none of ours or overflowed, by reason.
        late_max_us: largest lateness of a wake-up since the last statistics.
        busy_max_us: largest computing time of a tick since then.
        overruns: ticks since the start whose work began after the next one was due,
            or that were skipped.
        offset_us: per peer, its clock minus the own one, as in force.
        bound_us: per peer, how far that is from the truth at most.
        delay_us: per peer, one-way delay: median since the last statistics; -1 where nothing came.
        delay_max_us: per peer, its largest.
        rtt_us: per peer, smallest round trip since the last statistics; -1 where none was made.
        clock_faults: per peer, since the start: samples that came before they were sent, beyond the bound,
            and windows that contradict those before.
        grid_error_us: how late the own grid of ticks is against the leader's.
        slew_ppb: by how much it lags the own clock to follow the leader's, ns/s.
    """

    v: int
    site: str
    boot: U64
    tick: TickNumber
    t_ns: int
    mode: str
    age_us: Annotated[dict[str, int], _unit("us", "now minus the stamp of the sample in use")]
    accepted: dict[str, int]
    late: dict[str, int]
    duplicate: dict[str, int]
    refused: dict[str, int]
    lost: dict[str, int] = {}
    superseded: dict[str, int] = {}
    copies: dict[str, int] = {}
    dropped: dict[str, int]
    late_max_us: Annotated[int, _unit("us", "largest lateness of a wake-up")]
    busy_max_us: Annotated[int, _unit("us", "largest computing time of a tick")]
    overruns: int
    offset_us: Annotated[dict[str, int], _unit("us", "the peer's clock minus the own one")] = {}
    bound_us: Annotated[
        dict[str, int], _unit("us", "how far that is from the truth at most")
    ] = {}
    delay_us: Annotated[dict[str, int], _unit("us", "one-way delay, median")] = {}
    delay_max_us: Annotated[dict[str, int], _unit("us", "one-way delay, largest")] = {}
    rtt_us: Annotated[dict[str, int], _unit("us", "smallest round trip")] = {}
    clock_faults: dict[str, int] = {}
    grid_error_us: Annotated[int, _unit("us", "how late the grid is against the leader's")] = 0
    slew_ppb: Annotated[int, _unit("ns/s", "by how much the grid lags the clock")] = 0


class Event(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Something that happened once; `text` says it to people, the other fields to programs.

    Attributes:
        v: version of this schema.
        member: who says it: a site, or "recorder".
        boot: the sender's process start.
        kind: "epoch", "ready", "start", "late", "lost", "back", "diverged", "end", "stored", "refused",
            "setup", "mode", "change", "clock", "clock fault", "failed", "law", "arm", "hand",
            "mark"; where sites come and go "left", "coming", "admit", "last", "join", "unheard", "heard";
            of a site that does not go to its peers "waiting", of ticks that it did not make "overrun".
        text: the sentence.
        t_ns: nominal time, ns since the epoch; -1 before it.
        attempt: number of the announcement that it belongs to.
        epoch_mono_ns: the epoch on the monotonic clock `clock`.
        epoch_unix_ns: the epoch in Unix time.
        clock: identity of that monotonic clock.
        boots: members of the session and their boots.
        about: the member that it concerns; of "end" whose end it was, "" if it was planned or asked for.
        ticks: how many ticks; of "clock" the tick from which on it holds; of "coming", "admit" and "join" the
            first tick of the site that comes; of "last" how many the start before it made at least.
        command: the change that was taken in, as the record of tick `ticks` names it.
        clocks: per member the identity of its clock.
        epochs: per member the epoch on its own clock.
        offset_ns: of "clock": the clock of `about` minus the own one, at that tick; of "clock fault" by how
            much a sample came before it was sent, or 0.
        bound_ns: how far that offset is from the truth at most, for a second from there; then it grows.
        drift_ppb: by how much the offset grows, ns/s.
        drift_bound_ppb: how far that is from the truth at most.
        n: which event of this boot it is, from 0; -1 before version 3.
    """

    v: int = VERSION
    member: str
    boot: U64
    kind: str
    text: str
    t_ns: int = -1
    attempt: int = 0
    epoch_mono_ns: Instant = 0
    epoch_unix_ns: int = 0
    clock: str = ""
    boots: dict[str, int] = {}
    about: str = ""
    ticks: int = 0
    command: str = ""
    clocks: dict[str, str] = {}
    epochs: dict[str, Instant] = {}
    offset_ns: int = 0
    bound_ns: int = 0
    drift_ppb: int = 0
    drift_bound_ppb: int = 0
    n: Annotated[int, Meta(ge=-1, lt=2**40)] = -1


class RecorderStats(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a recorder knows of its own work, once a second; what is counted, is since its start.

    Attributes:
        v: version of this schema.
        boot: the recorder's process start.
        t_ns: when, ns since the epoch, on its own clock.
        expected: per channel (as in "m1/state") the messages that there should be by now, as far as known.
        received: those that are in the file.
        missing: those that are not.
        gaps: the missing ones as ranges of numbers, "first-last", at most twenty.
        duplicate: those that came twice, not written again.
        reordered: those that came after a later one.
        refilled: those that came from a site's memory, after they had been missing.
        overflowed: those lost because the recorder's queue was full.
        silence_us: the longest time between two of them, as they came.
        dropped: messages that were none of the session's, by reason.
        queued: messages that wait to be written.
        written_bytes: size of the file.
        flush_max_us: the longest that handing it to the operating system has taken since the last statistics.
        mono_ns: the recorder's monotonic clock.
        unix_ns: its wall clock at that instant.
    """

    v: int = VERSION
    boot: U64
    t_ns: Annotated[int, _unit("ns", "time since the session's epoch")]
    expected: dict[str, int]
    received: dict[str, int]
    missing: dict[str, int]
    gaps: dict[str, list[str]] = {}
    duplicate: dict[str, int] = {}
    reordered: dict[str, int] = {}
    refilled: dict[str, int] = {}
    overflowed: dict[str, int] = {}
    silence_us: Annotated[dict[str, int], _unit("us", "longest time between two messages")] = {}
    dropped: dict[str, int] = {}
    queued: int = 0
    written_bytes: Annotated[int, _unit("byte", "size of the file")] = 0
    flush_max_us: Annotated[int, _unit("us", "longest flush since the last statistics")] = 0
    mono_ns: Instant = 0
    unix_ns: int = 0


class Info(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Identity of a member, which it sends in reply to queries.

    Attributes:
        v: Version of this schema.
        member: Name of the member.
        boot: Random number that identifies this start of the member's process.
        scenario_sha256: Hash of the resolved scenario. Empty for a recorder, which obtains the
            scenario from the sites.
        scenario: Text of the resolved scenario. Empty for a recorder.
        host: Name of the member's machine.
        clock: Identity of the member's monotonic clock. Members with the same clock run on the
            same machine.
        fingerprint: Fingerprint of the floating-point arithmetic on the member's platform.
        needs_recorder: True if the member starts the session only when a recorder is present.
        running: True if the epoch of the session (its common start time) is fixed.
        ticks: Number of ticks that the member has executed.
        epoch_mono_ns: The epoch on the member's clock, once it is fixed.
        epoch_unix_ns: The epoch in Unix time.
        boots: Mapping from name to boot for each member of the session.
        grid_ns: Time on the member's clock from which its ticks are currently counted. It
            differs from the epoch if the member has had to follow the drifting clock of the
            first site.
    """

    v: int = VERSION
    member: str
    boot: U64
    scenario_sha256: str
    scenario: str
    host: str
    clock: str
    fingerprint: str
    needs_recorder: bool = False
    running: bool = False
    ticks: int = 0
    epoch_mono_ns: Instant = 0
    epoch_unix_ns: int = 0
    boots: dict[str, int] = {}
    grid_ns: Instant = 0


TASK_VECTORS = ("x", "xd", "wrench")
STATE_VECTORS = (*Layout().lengths(), *TASK_VECTORS, "ch", "hand", "bodies")
"""Names of the vectors in a record. The `Layout` of a site defines their lengths."""


def json_schema(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Returns the JSON Schema of a message type.

    msgspec nests the schema in a list of components, whereas log viewers expect it at the root.
    """
    (_,), components = msgspec.json.schema_components([kind])
    schema: dict[str, Any] = components[kind.__name__]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


# `python -OO` removes all docstrings. The schemas in a log contain them, so restore them here.
if sys.flags.optimize > 1:
    for _node in ast.parse(Path(__file__).read_bytes()).body:
        if isinstance(_node, ast.ClassDef):
            globals()[_node.name].__doc__ = ast.get_docstring(_node, clean=False)
