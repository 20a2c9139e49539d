"""Expectations of a run: the tables [expect] and [[expect.windows]] of a scenario.

`trilat test` evaluates them.

Invariant:
    - A key names a quantity, its limit and its unit, and its docstring defines the quantity
      exactly. An absent key expects nothing.
    - `..._max_...` is the largest value that still holds, `..._min_...` the smallest. The key
      of a window holds [least, most].
"""

import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from msgspec import Meta

from ..core.chain import MAX_JOINTS
from ..errors import ScenarioError
from ..fields import (
    Joints,
    KeyProblem,
    NotNegative,
    Positive,
    Real,
    TomlTable,
    check_keys,
    field_names,
    suggest_nearest,
)

WindowTime = Annotated[float, Meta(ge=0.0, le=86_400.0)]
LeastMost = Annotated[tuple[Real, ...], Meta(min_length=2, max_length=2)]

ALL_SITES_QUANTITIES = ("error_peak_rad", "speed_peak_rad_s", "torque_peak_nm")
"""Quantities of all sites together."""


class _RunPart(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True
):
    from_s: WindowTime
    to_s: WindowTime
    site: str = ""
    error_peak_rad: LeastMost | None = None
    speed_peak_rad_s: LeastMost | None = None
    torque_peak_nm: LeastMost | None = None


_JOINT_KEYS = [
    key.format(n) for key in ("q{}_rad", "push{}_mean_nm") for n in range(1, MAX_JOINTS + 1)
]
if TYPE_CHECKING:
    _JointPart = _RunPart
else:
    _fields = [(key, LeastMost | None, None) for key in _JOINT_KEYS]
    _JointPart = msgspec.defstruct(
        "_JointPart", _fields, bases=(_RunPart,), frozen=True, kw_only=True
    )


class ExpectWindow(_JointPart, frozen=True, kw_only=True):
    """Expectations of the ticks from one time to another, as [least, most] of each quantity.

    The force of the walls is computed from the logged state, along their normals, and added up
    if the scenario has several walls. If a run ends before the window ends, the window is not
    measured, and its expectations fail.

    Attributes:
        from_s: nominal time of the first tick of the window, s.
        to_s: end of the window, s; a tick at that time does not belong to the window.
        site: the site; left out: all sites, which only the first three quantities allow.
        error_peak_rad: largest |e| of a joint.
        speed_peak_rad_s: largest speed of a joint.
        torque_peak_nm: largest control torque of a joint.
        q1_rad: angle of joint 1 at every tick, m for a prismatic joint; q2_rad is that of joint
            2, and so on up to the last joint. If a URDF names the joints, q_NAME_rad may be
            written as well.
        push1_mean_nm: mean over the ticks of the torque of operator and environment ON joint 1;
            push2_mean_nm is that of joint 2, and so on. If a URDF names the joints,
            push_NAME_mean_nm may be written as well.
        wall_mean_n: mean over the ticks of the force of the walls, with or without contact.
        wall_deviation_n: standard deviation of that force over the ticks (of the population).
        wall_peak_n: largest force of the walls.
        wall_hits: number of contacts that begin: ticks of the window with a force after a tick
            of the window without one.
    """

    wall_mean_n: LeastMost | None = None
    wall_deviation_n: LeastMost | None = None
    wall_peak_n: LeastMost | None = None
    wall_hits: LeastMost | None = None

    @property
    def limits(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        """Yields each quantity that the window limits, with its [least, most]."""
        for key in _QUANTITIES:
            limits = getattr(self, key)
            if limits is not None:
                yield key, limits


_WINDOW_KEYS = field_names(ExpectWindow)
_QUANTITIES = tuple(key for key in _WINDOW_KEYS if key not in ("from_s", "to_s", "site"))
_JOINT_QUANTITY = re.compile(r"(?:q|push)(\d+)_")


def window_quantities(joints: int) -> tuple[str, ...]:
    """Returns the quantities of a window for an arm with `joints` joints."""
    quantities = []
    for key in _QUANTITIES:
        number = _JOINT_QUANTITY.match(key)
        if number is None or int(number[1]) <= joints:
            quantities.append(key)
    return tuple(quantities)


def number_window_joints(written: Any, joint_names: Mapping[str, tuple[str, ...]]) -> Any:
    """Returns the windows of a file with numbers in place of the names of joints in keys.

    q_elbow_rad becomes q3_rad if the elbow is the third joint.

    Args:
        written: the windows; anything but a list of tables is returned as it is, and refused
            later.
        joint_names: the names of the joints of each site's arm, in their order.

    Raises:
        ScenarioError: a window has no such key, or has a key twice.
    """
    if not isinstance(written, list):
        return written
    windows = []
    for n, table in enumerate(written):
        path = f"expect.windows[{n}]"
        window = table
        if isinstance(table, dict):
            site = table.get("site", "")
            names = joint_names.get(site, ()) if isinstance(site, str) else ()
            window = _number_joints(table, names, path)
        windows.append(check_keys(window, _WINDOW_KEYS, path))
    return windows


def _number_joints(table: TomlTable, names: tuple[str, ...], path: str) -> TomlTable:
    """Returns a window with numbers in place of the names of joints in its keys."""
    window: TomlTable = {}
    for key, value in table.items():
        prefix, name, suffix = _split_joint_key(key)
        numbered_key = key
        if name in names:
            numbered_key = f"{prefix}{names.index(name) + 1}{suffix}"
        if numbered_key in window or (numbered_key != key and numbered_key in table):
            raise ScenarioError(f"repeats {numbered_key}", path=f"{path}.{key}")
        window[numbered_key] = value
    return window


def _split_joint_key(key: str) -> tuple[str, str, str]:
    """Returns prefix, name and suffix of a key that names a joint, or empty texts.

    "q_elbow_rad" is split into "q", "elbow" and "_rad".
    """
    for prefix, suffix in (("q", "_rad"), ("push", "_mean_nm")):
        if key.startswith(f"{prefix}_") and key.endswith(suffix):
            name = key.removeprefix(f"{prefix}_").removesuffix(suffix)
            return prefix, name, suffix
    return "", "", ""


def find_window_problem(
    window: ExpectWindow, joint_counts: Mapping[str, int]
) -> KeyProblem | None:
    """Returns a problem of a window for which no run could meet it, or None.

    Args:
        window: the window.
        joint_counts: the number of joints of each site's arm.
    """
    sites = f"its sites are {', '.join(joint_counts)}"
    if window.to_s <= window.from_s:
        return KeyProblem(
            "to_s", f"must be later than from_s = {window.from_s:g}, is {window.to_s:g}"
        )
    if window.site and window.site not in joint_counts:
        hint = suggest_nearest(window.site, list(joint_counts))
        return KeyProblem("site", f"no site {window.site!r}{hint}; {sites}")
    limits = dict(window.limits)
    if not limits:
        valid = window_quantities(max(joint_counts.values()))
        return KeyProblem("", f"expects nothing; it may have {', '.join(valid)}")
    for key, (least, most) in limits.items():
        if not window.site and key not in ALL_SITES_QUANTITIES:
            return KeyProblem("site", f"is missing: {key} is of one site; {sites}")
        if window.site:
            joints = joint_counts[window.site]
            if key not in window_quantities(joints):
                return KeyProblem(key, f"there is no such joint: that arm has {joints}")
        if least > most:
            return KeyProblem(key, f"must be [least, most], is [{least:g}, {most:g}]")
    return None


END_WINDOW_S = 1.0
"""Length of the part of a run that the keys `end_...` cover, s."""


class Expect(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True
):
    """Expectations of every run of a scenario, for every seed.

    The error of a site is e = q_i - q_id, Eq. (9); |e| is taken per joint. "Largest" and
    "smallest" are over all sites (or links), joints and ticks of the run. A run that diverged
    ends at that tick: its figures are those of the part before, and the run fails unless
    `stable = false` is expected.

    Attributes:
        stable: true: the run is stable; false: it is not. An open run fails both, see
            `analysis.run_end`.
        synchronised_by_s: from this time to the end of the run the largest |e| stays below
            `synchronised_rad`.
        synchronised_rad: the limit of |e| below which the sites are synchronised, rad.
        peak_error_max_rad: largest |e| of the run.
        peak_error_min_rad: lower limit of that figure.
        rms_error_max_rad: root mean square of e over the run, of the worst joint of any site.
        end_error_max_rad: largest |e| of the last second.
        end_error_min_rad: lower limit of that figure.
        end_spread_max_rad: largest difference between two sites' angles of one joint at the
            same time, without delay, in the last second; at the ticks of the first site.
        end_pose_rad: joint angles of a site at its last tick, by the site's name, rad.
        end_pose_within_rad: largest deviation of each of those angles, rad.
        peak_torque_max_nm: largest control torque of a joint.
        peak_speed_max_rad_s: largest speed of a joint.
        age_max_ms: largest age of the sample in use (now minus its stamp), from the first
            sample of a link on; a link that never has a sample in use fails.
        mean_age_max_ms: upper limit of that age averaged over the ticks of a link, for the link
            with the largest average.
        mean_age_min_ms: lower limit of that average, for the link with the smallest average.
        late_samples_max: samples of all links that arrived after they were due.
        no_gaps: true: there is a record of every tick, from 0 to the last tick that any site
            had to make; false: nothing is expected.
        windows: expectations of parts of the run, see `ExpectWindow`.
        metrics: [least, most] of any number that `trilat metrics` measures, by its key, over
            the whole run as in `trilat compare`.
    """

    stable: bool | None = None
    synchronised_by_s: NotNegative | None = None
    synchronised_rad: Positive = 0.01
    peak_error_max_rad: NotNegative | None = None
    peak_error_min_rad: NotNegative | None = None
    rms_error_max_rad: NotNegative | None = None
    end_error_max_rad: NotNegative | None = None
    end_error_min_rad: NotNegative | None = None
    end_spread_max_rad: NotNegative | None = None
    end_pose_rad: dict[str, Joints] = {}
    end_pose_within_rad: Positive = 0.01
    peak_torque_max_nm: NotNegative | None = None
    peak_speed_max_rad_s: NotNegative | None = None
    age_max_ms: NotNegative | None = None
    mean_age_max_ms: NotNegative | None = None
    mean_age_min_ms: NotNegative | None = None
    late_samples_max: Annotated[int, Meta(ge=0)] | None = None
    no_gaps: bool = False
    windows: tuple[ExpectWindow, ...] = ()
    metrics: dict[str, LeastMost] = {}

    @property
    def has_expectations(self) -> bool:
        """True if at least one key states an expectation; a tolerance alone does not."""
        tolerances = {"synchronised_rad": 0.01, "end_pose_within_rad": 0.01}
        return msgspec.structs.replace(self, **tolerances) != Expect()


def find_expect_problem(expect: Expect, joint_counts: Mapping[str, int]) -> KeyProblem | None:
    """Returns a problem of the expectations for which no run could meet them, or None.

    Args:
        expect: the expectations.
        joint_counts: the number of joints of each site's arm.

    Returns:
        A problem with the path of its key below `expect`.
    """
    for name, pose in expect.end_pose_rad.items():
        key = f"end_pose_rad.{name}"
        if name not in joint_counts:
            return KeyProblem(key, f"no such site; its sites are {', '.join(joint_counts)}")
        joints = joint_counts[name]
        if len(pose) != joints:
            return KeyProblem(
                key,
                f"expected list of length {joints}, one angle per joint, and it has "
                f"{len(pose)}",
            )
    for n, window in enumerate(expect.windows):
        problem = find_window_problem(window, joint_counts)
        if problem is not None:
            return problem._replace(key=f"windows[{n}].{problem.key}".rstrip("."))
    for metric, (low, high) in expect.metrics.items():
        if low > high:
            return KeyProblem(
                f"metrics.{metric}", f"must be [least, most], is [{low:g}, {high:g}]"
            )
    for min_key, max_key in (
        ("peak_error_min_rad", "peak_error_max_rad"),
        ("end_error_min_rad", "end_error_max_rad"),
        ("mean_age_min_ms", "mean_age_max_ms"),
    ):
        least = getattr(expect, min_key)
        most = getattr(expect, max_key)
        if least is not None and most is not None and least > most:
            return KeyProblem(min_key, f"must be at most {max_key} = {most:g}, is {least:g}")
    return None
