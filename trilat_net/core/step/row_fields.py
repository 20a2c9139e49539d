"""Defines the arrays that hold the state of a simulated arm and of its network links.

They are NumPy structured arrays, whose elements are called rows. Each class below describes one
kind of row. For each field, for example `q` in `SiteRow`, it states the shape, the unit, the
meaning, and the stage of a control period that writes the field. The attribute types are there
for readers and mypy; `row_dtype` derives the memory layout from the `Field` of each attribute.
`core/README.md` shows the same information as tables.

Invariant:
    - The order of the attributes is the order of the fields in memory. Digests of runs, cached
      machine code and users' compiled control laws depend on it.
    - The compiled code of a control period keeps no state outside of these rows and the tables
      in `SiteArrays`.
"""

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, Protocol, get_args, get_type_hints

import numpy as np

from ..arms.two_link_arm import JOINTS, PARAMETERS
from .vectors import Array


class Field(NamedTuple):
    """Description of one field of a structured array: its shape, unit, meaning and origin.

    The data types of the arrays and their documentation are generated from these descriptions.

    Attributes:
        shape: Axes, joined by " x ". Each axis is a number, or a name such as "joints" whose
            length depends on the arm. Empty for a scalar.
        unit: Unit of the values. If the field holds a member of an enumeration, the name of the
            enumeration. Empty for counts, indices and flags.
        meaning: Quantity stored in the field.
        stage: Stage of a control period that writes the field, see README.md. Otherwise "setup"
            for constants, "input" for values that are written before the period, or "scratch"
            for intermediate results.
        chain_only: True if the field exists only for an arm that is a chain of joints.
        kind: NumPy code of the element type.
    """

    shape: str
    unit: str
    meaning: str
    stage: str
    chain_only: bool = False
    kind: str = ""


class SiteRow(Protocol):
    """Complete state of a site, as fields for its settings, gains, motion and results.

    Compiled code reads and writes these fields of a structured array element. The axis "shared"
    has one element per coordinate that arms send to each other. Users' compiled control laws
    read these fields through `LawInput`, whose fields therefore have the same names.
    """

    rate_hz: Annotated[int, Field("", "Hz", "tick rate", "setup")]
    first: Annotated[int, Field("", "tick", "first tick that the site computes", "setup")]
    digital: Annotated[int, Field("", "", "1: the law is sampled with a hold", "setup")]
    law: Annotated[int, Field("", "Law", "control law", "setup")]
    external: Annotated[int, Field("", "", "1: the arm is measured, not integrated", "setup")]
    ramps: Annotated[int, Field("", "", "filled rows of `SiteArrays.ramps`", "input")]
    on_stale: Annotated[int, Field("", "StaleAction", "rule for a stale peer", "setup")]
    stale_ns: Annotated[int, Field("", "ns", "age beyond which a peer is stale", "setup")]
    return_ns: Annotated[int, Field("", "ns", "duration of the return to the peers", "setup")]
    theta_known: Annotated[int, Field("", "", "1: `theta` describes the real arm", "setup")]
    needs_model: Annotated[int, Field("", "", "1: a user's law reads M and bias", "setup")]
    remembered: Annotated[
        int, Field("", "", "numbers in the memory of a user's compiled law", "setup")
    ]
    asked: Annotated[
        int,
        Field(
            "",
            "",
            "1 while a user's compiled law runs, which then causes any error",
            "6 torque",
        ),
    ]
    order: Annotated[
        int,
        Field(
            "", "LifeOrder", "order to carry out at the next tick, 0 without an order", "input"
        ),
    ]
    skipped: Annotated[int, Field("", "ticks", "ticks missed before this one", "input")]
    degrades: Annotated[int, Field("", "", "1: the site continues without lost peers", "setup")]
    regrouped: Annotated[
        int,
        Field(
            "",
            "LifeReason",
            "DROPPED or RESTORED after such a change in this tick, else 0",
            "3 reference",
        ),
    ]
    bit: Annotated[int, Field("", "", "the site's bit in sets of sites", "setup")]
    holds: Annotated[
        int, Field("", "", "1: a user's law also works while its reference rests", "setup")
    ]
    joints: Annotated[int, Field("", "", "joints of the arm", "setup")]
    shared: Annotated[int, Field("", "", "coordinates that sites exchange", "setup")]
    parameters: Annotated[int, Field("", "", "dynamic parameters of the arm", "setup")]
    task: Annotated[int, Field("", "", "1: sites exchange end effector poses", "setup")]
    sent: Annotated[int, Field("", "", "values in a record that the law sends", "setup")]
    mode: Annotated[
        int, Field("", "Mode", "mode; DIVERGED also by stages 6 to 8", "3 reference")
    ]
    return_from_ns: Annotated[
        int,
        Field("", "ns", "start of the return, the alignment or the rest", "3 reference"),
    ]
    reason: Annotated[
        int, Field("", "LifeReason", "why the mode last changed, under `glide`", "3 reference")
    ]

    g: Annotated[float, Field("", "m/s^2", "gravity of the planar arm", "setup")]
    wall_n: Annotated[float, Field("", "N", "largest force of a wall", "6 torque")]
    align_speed: Annotated[
        float, Field("", "rad/s or m/s", "largest speed of an alignment", "setup")
    ]
    align_limit: Annotated[
        float, Field("", "rad or m", "longest distance of an alignment", "setup")
    ]
    lengths: Annotated[
        Array, Field("2", "m", "lengths of the links of the planar arm", "setup")
    ]
    k: Annotated[int, Field("", "tick", "present tick, for a user's law", "6 torque")]
    t_s: Annotated[
        float, Field("", "s", "nominal time of the tick, for a user's law", "6 torque")
    ]
    h_s: Annotated[float, Field("", "s", "period, for a user's law", "6 torque")]
    M: Annotated[
        Array, Field("joints x joints", "kg m^2", "inertia, for a user's law", "6 torque")
    ]

    tau_limit: Annotated[Array, Field("joints", "N m", "largest control torque", "setup")]
    qd_limit: Annotated[
        Array, Field("joints", "rad/s", "speed of divergence or FAULT", "setup")
    ]
    Kp: Annotated[Array, Field("joints", "N m s/rad", "gain of r, Eq. (13)", "setup")]
    d: Annotated[Array, Field("joints", "N m s/rad", "damping of the law KNOWN", "setup")]
    q: Annotated[
        Array, Field("joints", "rad", "joint angles at t_k; t_{k+1} after 8", "8 advance")
    ]
    qd: Annotated[Array, Field("joints", "rad/s", "joint velocities, as q", "8 advance")]
    tau: Annotated[Array, Field("joints", "N m", "control torque", "6 torque")]
    tau_before: Annotated[
        Array, Field("joints", "N m", "tau of the previous tick", "8 advance")
    ]
    on_arm: Annotated[
        Array, Field("joints", "N m", "exogenous torque ON the arm: -tau_x", "6 torque")
    ]
    held: Annotated[
        Array, Field("joints", "N m", "part of on_arm that is held over the period", "6 torque")
    ]
    sensed: Annotated[Array, Field("joints", "N m", "measured torque ON the arm", "input")]
    r: Annotated[Array, Field("joints", "rad/s", "qd + Lambda e, Eq. (10)", "4 errors")]
    u: Annotated[
        Array,
        Field(
            "joints", "N m", "torque held over the period; in 6: tau without limit", "8 advance"
        ),
    ]
    tau_x: Annotated[Array, Field("joints", "N m", "-on_arm, for a user's law", "6 torque")]
    q_before: Annotated[Array, Field("joints", "rad", "q of the previous tick", "8 advance")]
    G: Annotated[Array, Field("joints", "N m", "gravity torque, for a user's law", "6 torque")]
    bias: Annotated[Array, Field("joints", "N m", "C qd + G, for a user's law", "6 torque")]
    rho: Annotated[Array, Field("joints", "N m", "largest robust torque", "setup")]
    width: Annotated[Array, Field("joints", "rad/s", "r at 71 % of rho", "setup")]
    friction: Annotated[
        Array, Field("joints", "", "fraction of friction that is compensated", "setup")
    ]
    q_min: Annotated[Array, Field("joints", "rad", "least joint angle", "setup")]
    q_max: Annotated[Array, Field("joints", "rad", "largest joint angle", "setup")]
    tau_rate: Annotated[Array, Field("joints", "N m/s", "largest rate of tau", "setup")]
    tau_held: Annotated[
        Array,
        Field("joints", "N m", "w of an arm at rest; torque left by a return", "6 torque"),
    ]
    q_rest: Annotated[
        Array, Field("joints", "rad", "rest reference in task space", "3 reference")
    ]
    qd_rest: Annotated[Array, Field("joints", "rad/s", "its rate", "3 reference")]
    damping: Annotated[Array, Field("joints", "N m s/rad", "B of an arm at rest", "setup")]
    integral: Annotated[Array, Field("joints", "N m/rad", "k B of an arm at rest", "setup")]
    deceleration: Annotated[
        Array, Field("joints", "rad/s^2", "deceleration of the rest reference", "setup")
    ]

    Lambda: Annotated[Array, Field("shared", "1/s", "rate of the error in r", "setup")]
    Kd: Annotated[Array, Field("shared", "N m s/rad", "gain of ed", "setup")]
    K: Annotated[Array, Field("shared", "N m/rad", "stiffness of the law KNOWN", "setup")]
    k_f: Annotated[Array, Field("shared", "", "gain of the reflected force", "setup")]
    q_held: Annotated[
        Array,
        Field("shared", "rad or m", "held reference, or offset of an alignment", "3 reference"),
    ]
    qd_held: Annotated[Array, Field("shared", "rad/s or m/s", "its rate", "3 reference")]
    q_des: Annotated[Array, Field("shared", "rad or m", "reference, Eq. (6)", "3 reference")]
    qd_des: Annotated[Array, Field("shared", "rad/s or m/s", "its rate", "3 reference")]
    q_followed: Annotated[
        Array, Field("shared", "rad or m", "reference of the previous tick", "3 reference")
    ]
    qd_followed: Annotated[Array, Field("shared", "rad/s or m/s", "its rate", "3 reference")]
    felt: Annotated[
        Array,
        Field(
            "shared", "N m or N", "torque on the peers' arms, weighted by share", "3 reference"
        ),
    ]
    e: Annotated[Array, Field("shared", "rad or m", "q - q_des, Eq. (9)", "4 errors")]
    ed: Annotated[Array, Field("shared", "rad/s or m/s", "its derivative", "4 errors")]
    qd_des_limit: Annotated[
        Array, Field("shared", "rad/s or m/s", "largest speed of the reference", "setup")
    ]

    theta: Annotated[Array, Field("parameters", "", "parameters of the arm", "setup")]
    known: Annotated[Array, Field("parameters", "", "parameters assumed by the law", "setup")]
    Gamma: Annotated[Array, Field("parameters", "", "adaptation gain, Eq. (15)", "setup")]
    low: Annotated[Array, Field("parameters", "", "least estimate", "setup")]
    high: Annotated[Array, Field("parameters", "", "largest estimate", "setup")]
    theta_hat: Annotated[
        Array,
        Field("parameters", "", "estimate; DIGITAL: by 8; user's law: by 6", "5 estimate"),
    ]
    Yr: Annotated[Array, Field("parameters", "", "Y' r", "4 errors")]
    Yr_before: Annotated[
        Array, Field("parameters", "", "Y' r of the previous tick; in 5 the sum", "8 advance")
    ]

    x: Annotated[
        Array, Field("shared", "m or rad", "end effector pose, task space", "3 reference")
    ]
    xd: Annotated[Array, Field("shared", "m/s or rad/s", "its derivative", "3 reference")]
    wrench: Annotated[
        Array, Field("shared", "N or N m", "tau_x at the end effector", "6 torque")
    ]
    axes: Annotated[Array, Field("shared", "", "1: the site follows along the axis", "setup")]
    b: Annotated[Array, Field("shared", "", "right side of (J J') y = b", "scratch")]
    y: Annotated[Array, Field("shared", "", "solution of (J J') y = b", "scratch")]

    posture: Annotated[Array, Field("joints", "rad", "preferred joint angles", "setup", True)]
    v: Annotated[Array, Field("joints", "rad/s", "reference velocity", "4 errors", True)]
    a: Annotated[Array, Field("joints", "rad/s^2", "reference acceleration", "4 errors", True)]
    zeros: Annotated[Array, Field("joints", "", "zeros", "setup", True)]
    stage_q: Annotated[
        Array, Field("joints", "rad", "q at a Runge-Kutta stage", "scratch", True)
    ]
    stage_qd: Annotated[Array, Field("joints", "rad/s", "its qd", "scratch", True)]
    stage_qdd: Annotated[Array, Field("joints", "rad/s^2", "its qdd", "scratch", True)]
    stage_torque: Annotated[Array, Field("joints", "N m", "its torque", "scratch", True)]
    sum_qd: Annotated[Array, Field("joints", "rad/s", "weighted sum of qd", "scratch", True)]
    sum_qdd: Annotated[
        Array, Field("joints", "rad/s^2", "weighted sum of qdd", "scratch", True)
    ]
    gravity: Annotated[Array, Field("3", "m/s^2", "gravity in the base frame", "setup", True)]
    tip: Annotated[Array, Field("3", "m", "end effector in the last link", "setup", True)]
    scale: Annotated[
        float, Field("", "m/m", "metres of the task per metre of this arm", "setup", True)
    ]
    posture_rate: Annotated[float, Field("", "1/s", "rate towards `posture`", "setup", True)]
    singular_value: Annotated[
        float, Field("", "m/rad", "least singular value without damping", "setup", True)
    ]
    J: Annotated[
        Array,
        Field("shared x joints", "m/rad", "Jacobian of the end effector", "3 reference", True),
    ]
    Jd: Annotated[
        Array, Field("shared x joints", "m/(rad s)", "its derivative", "3 reference", True)
    ]
    A: Annotated[Array, Field("shared x shared", "", "factors of J J'", "4 errors", True)]
    tip_back: Annotated[
        Array, Field("3 x 3", "", "transposed rotation of the end effector", "setup", True)
    ]

    # A chain has the field Y too, because Numba compiles the leaves of the planar arm for every
    # row.
    Y: Annotated[
        Array, Field(f"{JOINTS} x {PARAMETERS}", "", "regressor, Eq. (12)", "4 errors")
    ]


class LinkRow(Protocol):
    """State of a network link, the one-way connection from a peer to this arm.

    It contains the sample in use (the newest sample of the peer whose simulated delay has
    passed) and the state of the random models of loss and delay. Before the first sample, q is
    the start pose of the peer and qd is zero (law L7 of docs/develop/design.md).
    """

    alpha: Annotated[
        float, Field("", "", "dominance factor: planned, then in force", "3 reference")
    ]
    alpha_rate: Annotated[float, Field("", "1/s", "its derivative", "3 reference")]
    rate_hz: Annotated[int, Field("", "Hz", "tick rate of the peer", "setup")]
    used: Annotated[
        int, Field("", "tick", "stamp of the sample in use; -1 before the first", "2 release")
    ]
    used_ns: Annotated[
        int, Field("", "ns", "time of the site's tick that released it", "2 release")
    ]
    tick: Annotated[int, Field("", "tick", "`used`, for a user's law", "6 torque")]
    new: Annotated[int, Field("", "", "1: this tick released it", "2 release")]
    age_s: Annotated[float, Field("", "s", "its age, for a user's law", "6 torque")]
    q: Annotated[Array, Field("shared", "rad or m", "the sample's q", "2 release")]
    qd: Annotated[Array, Field("shared", "rad/s or m/s", "the sample's qd", "2 release")]
    tau_x: Annotated[Array, Field("shared", "N m or N", "the sample's tau_x", "2 release")]
    key: Annotated[np.uint64, Field("", "", "key of the link's draws", "setup")]
    bit: Annotated[int, Field("", "", "the peer's bit in sets of sites", "setup")]
    followed: Annotated[int, Field("", "", "set of sites that the peer follows", "setup")]
    dispensable: Annotated[int, Field("", "", "1: the site may drop the peer", "setup")]
    gone: Annotated[
        float,
        Field("", "ns", "0: present; -1: lost; > 0: heard again since", "3 reference"),
    ]
    models: Annotated[int, Field("", "", "filled rows of `LinkArrays.models`", "input")]
    model: Annotated[int, Field("", "", "row of the model in force", "2 release")]
    outage_first: Annotated[int, Field("", "", "first outage in `points`", "setup")]
    outage_count: Annotated[int, Field("", "", "outages in `points`", "setup")]
    scheduled: Annotated[
        int, Field("", "tick", "newest sample with a due time or a loss", "2 release")
    ]
    bad: Annotated[int, Field("", "", "1: the loss chain is in its bad state", "2 release")]
    due_before: Annotated[int, Field("", "ns", "latest due time so far", "2 release")]
    memory: Annotated[float, Field("", "", "last number of the AR(1) delay", "2 release")]
    accepted: Annotated[int, Field("", "samples", "samples that arrived", "1 accept")]
    late: Annotated[
        int,
        Field("", "samples", "samples that arrived after their tick of release", "1 accept"),
    ]
    duplicate: Annotated[
        int, Field("", "samples", "samples that had arrived before", "1 accept")
    ]
    refused: Annotated[
        int, Field("", "samples", "samples with a stamp out of range", "1 accept")
    ]
    lost: Annotated[
        int,
        Field("", "samples", "samples lost by the link's model, or far too old", "1 accept"),
    ]
    superseded: Annotated[
        int,
        Field("", "samples", "samples not used, because a newer one was (1, 2)", "1 accept"),
    ]
    copies: Annotated[
        int, Field("", "samples", "samples duplicated by the link's model", "2 release")
    ]


class SampleRow(Protocol):
    """A message from another arm, waiting for its simulated network delay to pass.

    The ring buffer of a link has one entry per control period of the receiver. Each entry holds
    the newest of the messages that become due in that period.
    """

    tick: Annotated[int, Field("", "tick", "stamp of the sample; -1: no sample", "1 accept")]
    q: Annotated[Array, Field("shared", "rad or m", "joint angles or pose", "1 accept")]
    qd: Annotated[Array, Field("shared", "rad/s or m/s", "its derivative", "1 accept")]
    tau_x: Annotated[Array, Field("shared", "N m or N", "exogenous torque", "1 accept")]


class ArrivalRow(Protocol):
    """A message from another arm that arrived since the previous control period."""

    peer: Annotated[int, Field("", "", "index of the link", "input")]
    tick: Annotated[int, Field("", "tick", "stamp of the sample", "input")]
    q: Annotated[Array, Field("shared", "rad or m", "joint angles or pose", "input")]
    qd: Annotated[Array, Field("shared", "rad/s or m/s", "its derivative", "input")]


class ProgressRow(Protocol):
    """Progress of the simulation of one arm, and statistics of its motion.

    The largest errors and speeds are collected per time interval (bucket).
    """

    tick: Annotated[int, Field("", "tick", "next tick", "fused run")]
    t_ns: Annotated[int, Field("", "ns", "its nominal time; NEVER_NS at the end", "fused run")]
    ticks: Annotated[int, Field("", "ticks", "ticks of the whole run", "setup")]
    rate_hz: Annotated[int, Field("", "Hz", "tick rate", "setup")]
    bucket: Annotated[int, Field("", "", "index of the present bucket", "fused run")]
    part: Annotated[
        int, Field("", "", "ticks of the bucket so far, times BUCKETS_PER_S", "fused run")
    ]
    unsettled_ns: Annotated[
        int,
        Field("", "ns", "last time of an error at the limit or above; -1: never", "fused run"),
    ]
    diverged_ns: Annotated[int, Field("", "ns", "time of divergence; -1: never", "fused run")]


class SumsRow(Protocol):
    """Sums over a simulated run of one arm, from which its metrics are computed at the end.

    For example, the root mean square error is derived from the sum of squared errors.
    """

    first_environment: Annotated[
        int, Field("", "", "index of the first environment; -1: no environment", "setup")
    ]
    effort: Annotated[float, Field("", "N^2 m^2", "sum of (tau - G)^2", "fused run")]
    force_peak_n: Annotated[float, Field("", "N", "largest force of a wall", "fused run")]
    environment_j: Annotated[float, Field("", "J", "work of the environments", "fused run")]
    errors: Annotated[Array, Field("joints", "rad^2", "sum of e^2", "fused run")]
    q: Annotated[Array, Field("joints", "rad", "q of the record before", "fused run")]
    now_before: Annotated[
        Array, Field("joints", "N m", "`now` of the record before", "fused run")
    ]
    held_before: Annotated[
        Array, Field("joints", "N m", "`held` of the record before", "fused run")
    ]
    G: Annotated[Array, Field("joints", "N m", "gravity torque", "scratch")]
    now: Annotated[Array, Field("joints", "N m", "present torque of environments", "scratch")]
    held: Annotated[Array, Field("joints", "N m", "held torque of environments", "scratch")]


_KINDS = {int: "i8", float: "f8", np.uint64: "u8", Array: "f8"}


def _read_fields(row: type) -> dict[str, Field]:
    """Reads the fields of a structured array from the class that describes them.

    The fields are in the order of the class attributes.

    Args:
        row: The class, for example `SiteRow`.
    """
    fields = {}
    for name, hint in get_type_hints(row, include_extras=True).items():
        kind, field = get_args(hint)
        fields[name] = field._replace(kind=_KINDS[kind])
    return fields


FIELDS: dict[str, dict[str, Field]] = {
    "site": _read_fields(SiteRow),
    "link": _read_fields(LinkRow),
    "sample": _read_fields(SampleRow),
    "arrival": _read_fields(ArrivalRow),
    "progress": _read_fields(ProgressRow),
    "sums": _read_fields(SumsRow),
}
"""The fields of each row type, keyed by row name and field name."""


def field_shape(field: Field, lengths: Mapping[str, int]) -> tuple[int, ...]:
    """Returns the shape of a field for a particular arm, for example (2,) for two joint angles.

    Args:
        field: The field, whose axes may be named, for example "joints".
        lengths: Length of each named axis.

    Returns:
        The shape, or () for a scalar field.
    """
    if not field.shape:
        return ()
    axes = field.shape.split(" x ")
    # An axis is a number, or the name of a length.
    return tuple(int(axis) if axis.isdigit() else lengths[axis] for axis in axes)


def row_dtype(
    row: str, lengths: Mapping[str, int], *, chain: bool = False
) -> np.dtype[np.void]:
    """Returns the NumPy data type for one kind of row, such as the state of an arm or a link.

    Vector lengths depend on the arm.

    Args:
        row: Key in `FIELDS`, for example "site" or "link".
        lengths: Number of joints, shared coordinates and dynamic parameters of the arm, under
            the keys "joints", "shared" and "parameters". Only the keys used by the fields are
            required.
        chain: True to include the fields that only a chain of joints needs.
    """
    columns: list[Any] = [
        (name, field.kind, field_shape(field, lengths))
        for name, field in FIELDS[row].items()
        if chain or not field.chain_only
    ]
    return np.dtype((np.record, columns))
