"""Expectations of a run: the table [expect] and its [[expect.windows]], evaluated by `trilat
test`.

Invariant: a key names a quantity, its limit and its unit, and its docstring defines the
quantity exactly; an absent key asks nothing. `..._max_...` is the largest value that still
holds, `..._min_...` the smallest; a window's key holds [least, most].
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

    A wall's force is that of the scenario's walls at the logged state, along their normals; of
    several it is the sum. If a run ends before the window does, nothing of it is measured, and
    nothing holds.

    Attributes:
        from_s: nominal time of its first tick, s.
        to_s: its end, s; it does not include a tick at that time.
        site: the site; left out: all, which only the first three quantities allow.
        error_peak_rad: largest |e| of a joint.
        speed_peak_rad_s: largest speed of a joint.
        torque_peak_nm: largest control torque of a joint.
        q1_rad: angle of joint 1, at every tick; q2_rad of joint 2, and so on as far as the arm
            has joints; m of a prismatic joint. Where a URDF names the joints, q_NAME_rad is
            written as well.
        push1_mean_nm: torque of operator and environment ON joint 1, the mean over the ticks;
            push2_mean_nm of joint 2, and so on; push_NAME_mean_nm so.
        wall_mean_n: force of the walls, the mean over the ticks, with or without contact.
        wall_deviation_n: its standard deviation over the ticks (of the population).
        wall_peak_n: the largest.
        wall_hits: how often it begins: ticks with force after one without, within the window.
    """

    wall_mean_n: LeastMost | None = None
    wall_deviation_n: LeastMost | None = None
    wall_peak_n: LeastMost | None = None
    wall_hits: LeastMost | None = None

    @property
    def limits(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        """Yields each quantity with a limit, and its least and most."""
        for key in _QUANTITIES:
            if (limits := getattr(self, key)) is not None:
                yield key, limits


_WINDOW_KEYS = field_names(ExpectWindow)
_QUANTITIES = tuple(key for key in _WINDOW_KEYS if key not in ("from_s", "to_s", "site"))
_JOINT_QUANTITY = re.compile(r"(?:q|push)(\d+)_")


def window_quantities(joints: int) -> tuple[str, ...]:
    """Returns the quantities of a window of a site whose arm has so many joints."""
    numbers = {key: _JOINT_QUANTITY.match(key) for key in _QUANTITIES}
    return tuple(
        key for key, number in numbers.items() if number is None or int(number[1]) <= joints
    )


def number_window_joints(written: Any, joint_names: Mapping[str, tuple[str, ...]]) -> Any:
    """Returns the windows of a file with keys that name joints, as q_elbow_rad, written by
    their numbers.

    `joint_names` has the names of the joints of each site's arm, in their order. What is no
    list of tables is refused later.

    Raises:
        ScenarioError: a window has no such key, or has one twice.
    """
    if not isinstance(written, list):
        return written
    windows = []
    for n, table in enumerate(written):
        numbered: dict[str, Any] = {}
        for key, value in table.items() if isinstance(table, dict) else ():
            kind, ending, name = _split_joint_key(key)
            names = joint_names.get(table.get("site", ""), ()) if name else ()
            known = f"{kind}{names.index(name) + 1}{ending}" if name in names else key
            if known in numbered or (known != key and known in table):
                raise ScenarioError(f"is {known} once more", path=f"expect.windows[{n}].{key}")
            numbered[known] = value
        window = numbered if isinstance(table, dict) else table
        windows.append(check_keys(window, _WINDOW_KEYS, f"expect.windows[{n}]"))
    return windows


def _split_joint_key(key: str) -> tuple[str, str, str]:
    for kind, ending in (("q", "_rad"), ("push", "_mean_nm")):
        if key.startswith(f"{kind}_") and key.endswith(ending):
            return kind, ending, key.removeprefix(f"{kind}_").removesuffix(ending)
    return "", "", ""


def find_window_problem(window: ExpectWindow, sites: Mapping[str, int]) -> KeyProblem | None:
    """Returns a window's problem that no run of a scenario with these sites could meet, or
    None.

    `sites` says how many joints the arm of each has.
    """
    names = f"its sites are {', '.join(sites)}"
    if window.to_s <= window.from_s:
        return KeyProblem(
            "to_s", f"must be later than from_s = {window.from_s:g}, is {window.to_s:g}"
        )
    if window.site and window.site not in sites:
        return KeyProblem(
            "site",
            f"no site {window.site!r}{suggest_nearest(window.site, list(sites))}; {names}",
        )
    limits = dict(window.limits)
    if not limits:
        valid = window_quantities(max(sites.values()))
        return KeyProblem("", f"asks nothing; it may ask {', '.join(valid)}")
    for key, (least, most) in limits.items():
        if not window.site and key not in ALL_SITES_QUANTITIES:
            return KeyProblem("site", f"is missing: {key} is of one site; {names}")
        if window.site and key not in window_quantities(sites[window.site]):
            return KeyProblem(key, f"there is no such joint: that arm has {sites[window.site]}")
        if least > most:
            return KeyProblem(key, f"must be [least, most], is [{least:g}, {most:g}]")
    return None


END_WINDOW_S = 1.0
"""The length of the end of a run that a key means, s."""


class Expect(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True
):
    """Expectations of every run of a scenario, for every seed.

    The error of a site is e = q_i - q_id, Eq. (9); |e| is taken per joint. "Largest" and
    "smallest" are over all sites (or links), joints and ticks of the run. A run that diverged
    ends there: its figures are of the part before, and it fails unless `stable = false` is
    asked.

    Attributes:
        stable: true: the run is stable; false: it is not. An open one fails both, see
            `analysis.run_end`.
        synchronised_by_s: from this time to the end of the run the largest |e| stays below
            `synchronised_rad`.
        synchronised_rad: the limit of |e| below which the sites are synchronised, rad.
        peak_error_max_rad: largest |e| of the run.
        peak_error_min_rad: the same figure, from below.
        rms_error_max_rad: root mean square of e over the run, of the worst joint of any site.
        end_error_max_rad: largest |e| of the last second.
        end_error_min_rad: the same figure, from below.
        end_spread_max_rad: largest difference between two sites' angles of one joint at one
            instant of the last second, undelayed; instants are the ticks of the first site.
        end_pose_rad: joint angles of a site's last tick, by the site's name, rad.
        end_pose_within_rad: how far each of those angles may be off, rad.
        peak_torque_max_nm: largest control torque of a joint.
        peak_speed_max_rad_s: largest speed of a joint.
        age_max_ms: largest age of the sample in use (now minus its stamp), from the first
            sample of a link on; a link that never has one fails.
        mean_age_max_ms: that age, averaged over a link's ticks; of the link where it is
            largest.
        mean_age_min_ms: the same average, of the link where it is smallest, from below.
        late_samples_max: samples of all links that arrived after they were due.
        no_gaps: true: there is a record of every tick, from 0 to the last that any site had to
            make; false asks nothing.
        windows: expectations of parts of the run, see `ExpectWindow`.
        metrics: [least, most] of any number that `trilat metrics` measures, by its key, of the
            whole run as `trilat compare` has it.
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
    end_pose_rad: dict[str, Joints] = {}  # written out, never one number for all joints
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


def find_expect_problem(expect: Expect, sites: Mapping[str, int]) -> KeyProblem | None:
    """Returns the problem, below `expect`, that no run of a scenario with these sites could
    meet, or None.

    `sites` says how many joints the arm of each has.
    """
    for name, pose in expect.end_pose_rad.items():
        if name not in sites:
            return KeyProblem(
                f"end_pose_rad.{name}", f"no such site; its sites are {', '.join(sites)}"
            )
        if len(pose) != sites[name]:
            problem = f"expected list of length {sites[name]}, one angle per joint, and it has {len(pose)}"
            return KeyProblem(f"end_pose_rad.{name}", problem)
    for n, window in enumerate(expect.windows):
        if found := find_window_problem(window, sites):
            return found._replace(key=f"windows[{n}].{found.key}".rstrip("."))
    for key, (low, high) in expect.metrics.items():
        if low > high:
            return KeyProblem(
                f"metrics.{key}", f"must be [least, most], is [{low:g}, {high:g}]"
            )
    for least, most in (
        ("peak_error_min_rad", "peak_error_max_rad"),
        ("end_error_min_rad", "end_error_max_rad"),
        ("mean_age_min_ms", "mean_age_max_ms"),
    ):
        floor = getattr(expect, least)
        ceiling = getattr(expect, most)
        if floor is not None and ceiling is not None and floor > ceiling:
            return KeyProblem(least, f"must be at most {most} = {ceiling:g}, is {floor:g}")
    return None
