"""Expectations of a scenario: conditions that its runs must satisfy.

Expectations are specified in the tables `[expect]` (for the entire run) and
`[[expect.windows]]` (for a time interval), and evaluated by `trilat test`. For example,
`peak_error_max_rad = 0.1` requires that the synchronisation error (the difference between a
joint angle and its reference) never exceeds 0.1 rad.

Invariant:
    - The name of a key consists of a quantity, a limit and a unit; its docstring defines the
      quantity exactly. A missing key imposes no condition.
    - `..._max_...` is the largest permitted value, and `..._min_...` the smallest. The keys of
      a window contain both, as [smallest, largest].
"""

import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated

import msgspec
from msgspec import Meta

from ..errors import ScenarioError, count_nouns, suggest_nearest
from ..fields import Joints, KeyProblem, NotNegative, Positive, Real, TomlTable
from ..records import MAX_JOINTS
from .arms import Arm
from .key_checks import check_keys, field_names

WindowTime = Annotated[float, Meta(ge=0.0, le=86_400.0)]
LeastMost = Annotated[tuple[Real, ...], Meta(min_length=2, max_length=2)]

ALL_SITES_QUANTITIES = ("error_peak_rad", "speed_peak_rad_s", "torque_peak_nm")
"""Quantities that can be evaluated over all sites together."""


class _RunPart(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True
):
    """Keys of a window that are the same for every arm (see `ExpectWindow`).

    The remaining keys name a joint, so they depend on the number of joints.
    """

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
    """Expected ranges of quantities during part of a run.

    Each quantity may be given a smallest and a largest permitted value. The wall force is
    computed from the logged state: it is the force along the normal, summed over all walls. If
    the run ends before the window does, nothing is measured and the expectations are not
    satisfied.

    Attributes:
        from_s: Start of the window (nominal time of its first tick), in s.
        to_s: End of the window, in s, exclusive.
        site: Name of the site. If omitted, all sites are evaluated together, which is possible
            only for the first three quantities.
        error_peak_rad: Largest absolute synchronisation error |e| of a joint.
        speed_peak_rad_s: Largest speed of a joint.
        torque_peak_nm: Largest control torque of a joint.
        q1_rad: Angle of joint 1 at every tick, in m for a prismatic joint. q2_rad is the angle
            of joint 2, and so on. If the URDF file names the joints, q_NAME_rad is also
            accepted.
        push1_mean_nm: Mean torque of operators and environment ON the first joint, averaged
            over the ticks. push2_mean_nm applies to joint 2, and so on. If the URDF file names
            the joints, push_NAME_mean_nm is also accepted.
        wall_mean_n: Mean wall force over all ticks, with or without contact.
        wall_deviation_n: Population standard deviation of the wall force over the ticks.
        wall_peak_n: Largest wall force.
        wall_hits: Number of contacts that begin in the window: ticks with a wall force whose
            preceding tick in the window has none.
    """

    wall_mean_n: LeastMost | None = None
    wall_deviation_n: LeastMost | None = None
    wall_peak_n: LeastMost | None = None
    wall_hits: LeastMost | None = None

    @property
    def limits(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        """Yields the name and limits of each quantity that is checked in this part of the run.

        The name ends in the unit. The limits are the smallest and the largest permitted value,
        for example (0.0, 0.01). Yields nothing if no quantity is checked.
        """
        for key in _QUANTITIES:
            limits = getattr(self, key)
            if limits is not None:
                yield key, limits

    @staticmethod
    def list_quantities(joints: int) -> tuple[str, ...]:
        """Returns the names of the quantities for which a scenario can specify limits.

        The list includes quantities of individual joints such as q1_rad, so its length depends
        on the arm.

        Args:
            joints: Number of joints of the arm.
        """
        quantities = []
        for key in _QUANTITIES:
            number = _JOINT_QUANTITY.match(key)
            if number is None or int(number[1]) <= joints:
                quantities.append(key)
        return tuple(quantities)


_WINDOW_KEYS = field_names(ExpectWindow)
_QUANTITIES = tuple(key for key in _WINDOW_KEYS if key not in ("from_s", "to_s", "site"))
_JOINT_QUANTITY = re.compile(r"(?:q|push)(\d+)_")


def _number_window_joints(
    written: list[TomlTable], joint_names: Mapping[str, tuple[str, ...]]
) -> list[TomlTable]:
    """Replaces joint names in the keys of windows with joint numbers.

    For example, q_elbow_rad becomes q3_rad if the elbow is the third joint.

    Args:
        written: Windows as written by their author.
        joint_names: Mapping from site name to the ordered names of the arm's joints.

    Returns:
        The windows with the new keys.

    Raises:
        ScenarioError: A window has an unknown key, or the same key twice.
    """
    windows = []
    for n, table in enumerate(written):
        path = f"expect.windows[{n}]"
        names = joint_names.get(str(table.get("site", "")), ())
        window = _number_joints(table, names, path)
        windows.append(check_keys(window, _WINDOW_KEYS, path))
    return windows


def _number_joints(table: TomlTable, names: tuple[str, ...], path: str) -> TomlTable:
    """Replaces joint names in the keys of one window with joint numbers.

    For example, "q_elbow_rad" becomes "q3_rad" if the elbow is the third joint of the arm.

    Args:
        table: The window.
        names: Names of the joints.
        path: Path of the window, for error messages.
    """
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
    """Splits a key that contains a joint name into prefix, name and suffix.

    For example, "q_elbow_rad" is split into "q", "elbow" and "_rad". All parts are empty if the
    key contains no joint name.
    """
    for prefix, suffix in (("q", "_rad"), ("push", "_mean_nm")):
        if key.startswith(f"{prefix}_") and key.endswith(suffix):
            name = key.removeprefix(f"{prefix}_").removesuffix(suffix)
            return prefix, name, suffix
    return "", "", ""


def _find_window_problem(
    window: ExpectWindow, joint_counts: Mapping[str, int]
) -> KeyProblem | None:
    """Looks for a reason why no run could satisfy a window of expectations.

    For example, a smallest permitted value may exceed the largest one.

    Args:
        window: Part of a run with the permitted ranges of some quantities.
        joint_counts: Mapping from site name to the number of joints of its arm.

    Returns:
        The key and the reason, or None if the window can be satisfied.
    """
    sites = f"the sites are {', '.join(joint_counts)}"
    if window.to_s <= window.from_s:
        return KeyProblem(
            "to_s", f"must be later than from_s = {window.from_s:g}, but is {window.to_s:g}"
        )
    if window.site and window.site not in joint_counts:
        hint = suggest_nearest(window.site, list(joint_counts))
        return KeyProblem("site", f"there is no site {window.site!r}{hint}; {sites}")

    limits = dict(window.limits)
    if not limits:
        valid = ExpectWindow.list_quantities(max(joint_counts.values()))
        return KeyProblem("", f"expects nothing; the possible keys are {', '.join(valid)}")
    for key, (least, most) in limits.items():
        if not window.site and key not in ALL_SITES_QUANTITIES:
            return KeyProblem("site", f"is missing: {key} belongs to a single site; {sites}")
        if window.site:
            joints = joint_counts[window.site]
            if key not in ExpectWindow.list_quantities(joints):
                return KeyProblem(
                    key, f"there is no such joint: the arm has {count_nouns(joints, 'joint')}"
                )
        if least > most:
            return KeyProblem(key, f"must be [least, most], but is [{least:g}, {most:g}]")
    return None


END_WINDOW_S = 1.0
"""Duration of the final part of a run, to which the keys `end_...` apply, in s."""


class Expect(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True
):
    """Conditions that every run of a scenario must satisfy, whatever the random seed.

    Checked by `trilat test`. The error of an arm is e = q_i - q_id, Eq. (9): its joint angles
    q_i minus the reference q_id. |e| is evaluated separately for each joint. "Largest" and
    "smallest" refer to all arms (or network links), all joints and all control periods. If an
    arm diverges, the run ends at that point: only the part before the divergence is evaluated,
    and the run fails unless `stable = false` is expected.

    Attributes:
        stable: True if the run must be stable, False if it must be unstable. A run whose
            stability cannot be decided fails in both cases (see `analysis.run_end`).
        synchronised_by_s: Time from which the largest |e| must stay below `synchronised_rad`
            until the end of the run, in s.
        synchronised_rad: Value of |e| below which the sites count as synchronised, in rad.
        peak_error_max_rad: Upper limit on the largest |e| of the run.
        peak_error_min_rad: Lower limit of the same quantity.
        rms_error_max_rad: Upper limit on the root mean square of e over the run, for the joint
            with the largest value.
        end_error_max_rad: Upper limit on the largest |e| in the last second.
        end_error_min_rad: Lower limit of the same quantity.
        end_spread_max_rad: Upper limit on the largest difference during the last second between
            the simultaneous (undelayed) angles of the same joint at two sites. Evaluated at the
            ticks of the first site.
        end_pose_rad: Mapping from site name to the expected joint angles at the last tick, in
            rad.
        end_pose_within_rad: Largest permitted deviation from each of these angles, in rad.
        peak_torque_max_nm: Upper limit on the control torque of a joint.
        peak_speed_max_rad_s: Upper limit on the speed of a joint.
        age_max_ms: Upper limit on the age of the sample in use (current time minus send time),
            from the first sample of each link on. A link of which no sample is ever used fails.
        mean_age_max_ms: Upper limit on this age averaged over the ticks, for the link with the
            largest average.
        mean_age_min_ms: Lower limit on this average, for the link with the smallest average.
        late_samples_max: Largest permitted number of samples, over all links, that arrived
            after they were due.
        no_gaps: If True, every tick must have a record, from tick 0 to the last tick that any
            site had to compute. If False, gaps are permitted.
        windows: Expectations for parts of the run (see `ExpectWindow`).
        metrics: Mapping from the key of a metric of `trilat metrics` to its [smallest, largest]
            permitted value over the entire run, as in `trilat compare`.
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

    @staticmethod
    def complete_table(
        written: TomlTable, sites: TomlTable, urdf_texts: Mapping[str, str]
    ) -> TomlTable:
        """Returns the `expect` table with joint names replaced by joint indices.

        The author may refer to a joint by its name in the URDF file of the arm.

        Args:
            written: Table `expect` as written by its author.
            sites: Mapping from site name to the complete table of the site.
            urdf_texts: Mapping from name to content of the URDF files.
        """
        if "windows" not in written:
            return written
        joint_names = {}
        for name, site in sites.items():
            if site["arm"].get("urdf"):
                chain = msgspec.convert(site["arm"], Arm).read_chain(urdf_texts)
                joint_names[name] = tuple(joint.name for joint in chain.joints)
        return {**written, "windows": _number_window_joints(written["windows"], joint_names)}

    @property
    def has_expectations(self) -> bool:
        """True if there is at least one condition that a run must satisfy.

        A tolerance alone does not count, since it only qualifies other conditions.
        """
        tolerances = {"synchronised_rad": 0.01, "end_pose_within_rad": 0.01}
        return msgspec.structs.replace(self, **tolerances) != Expect()

    def find_problem(self, joint_counts: Mapping[str, int]) -> KeyProblem | None:
        """Looks for an expectation that no run could satisfy.

        For example, an expected end pose must have as many angles as the arm has joints. Such a
        problem is reported when the scenario is loaded instead of after a long run.

        Args:
            joint_counts: Mapping from site name to the number of joints of its arm.

        Returns:
            The reason and the path of the key relative to `expect`, or None if there is no
            problem.
        """
        for name, pose in self.end_pose_rad.items():
            key = f"end_pose_rad.{name}"
            if name not in joint_counts:
                return KeyProblem(
                    key, f"there is no such site; the sites are {', '.join(joint_counts)}"
                )
            joints = joint_counts[name]
            if len(pose) != joints:
                return KeyProblem(
                    key,
                    f"must be a list of length {joints}, one angle per joint, but has length "
                    f"{len(pose)}",
                )

        for n, window in enumerate(self.windows):
            problem = _find_window_problem(window, joint_counts)
            if problem is not None:
                return problem._replace(key=f"windows[{n}].{problem.key}".rstrip("."))

        for metric, (low, high) in self.metrics.items():
            if low > high:
                return KeyProblem(
                    f"metrics.{metric}", f"must be [least, most], but is [{low:g}, {high:g}]"
                )

        for min_key, max_key in (
            ("peak_error_min_rad", "peak_error_max_rad"),
            ("end_error_min_rad", "end_error_max_rad"),
            ("mean_age_min_ms", "mean_age_max_ms"),
        ):
            least = getattr(self, min_key)
            most = getattr(self, max_key)
            if least is not None and most is not None and least > most:
                return KeyProblem(
                    min_key, f"must be at most {max_key} = {most:g}, but is {least:g}"
                )
        return None
