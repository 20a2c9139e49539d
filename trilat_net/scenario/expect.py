"""Defines the expectations of a scenario: conditions that its runs must satisfy.

A scenario is a TOML file that describes an experiment. Its author writes the expectations in
the tables `[expect]` (for the whole run) and `[[expect.windows]]` (for an interval of time),
and the command `trilat test` evaluates them. For example, `peak_error_max_rad = 0.1` requires
that no synchronisation error, the difference between the angle of a joint and the angle that it
should follow, exceeds 0.1 rad.

Invariant:
    - The name of a key contains a quantity, a limit and a unit. Its docstring defines the
      quantity exactly. A missing key is not a condition.
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
    """Keys for a part of a run (window) that are the same for every arm, see `ExpectWindow`.

    The other keys name a joint, so they depend on the number of joints.
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
    """Expected ranges of quantities in a part of a run, which a test checks.

    For each quantity, the smallest and the largest permitted value may be stated. The force of
    the walls is computed from the logged state. This force acts along the normal, and is summed
    over the walls of the experiment. If a run ends before the window ends, the quantities are
    not measured, and the expectations count as not satisfied.

    Attributes:
        from_s: Nominal time of the first tick of the window, in s.
        to_s: End of the window, in s. A tick at this time does not belong to the window.
        site: Name of the site. If it is left out, all sites are evaluated together, which only
            the first three quantities allow.
        error_peak_rad: Largest absolute synchronisation error |e| of a joint.
        speed_peak_rad_s: Largest speed of a joint.
        torque_peak_nm: Largest control torque of a joint.
        q1_rad: Angle of joint 1 at every tick, in m for a prismatic joint. q2_rad is the angle
            of joint 2, and so on. If the URDF file names the joints, q_NAME_rad may be written
            as well.
        push1_mean_nm: Mean over the ticks of the torque of operators and environment ON joint
            1. push2_mean_nm belongs to joint 2, and so on. If the URDF file names the joints,
            push_NAME_mean_nm may be written as well.
        wall_mean_n: Mean over the ticks of the force of the walls, with or without contact.
        wall_deviation_n: Standard deviation of this force over the ticks (of the population).
        wall_peak_n: Largest force of the walls.
        wall_hits: Number of contacts that begin: ticks with a force that follow a tick of the
            window without a force.
    """

    wall_mean_n: LeastMost | None = None
    wall_deviation_n: LeastMost | None = None
    wall_peak_n: LeastMost | None = None
    wall_hits: LeastMost | None = None

    @property
    def limits(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        """Yields each quantity that is checked in this part of a run, with its limits.

        Each item is the name of a quantity, which ends in its unit, and a pair of the smallest
        and the largest permitted value, for example (0.0, 0.01). Nothing is yielded if no
        quantity is checked.
        """
        for key in _QUANTITIES:
            limits = getattr(self, key)
            if limits is not None:
                yield key, limits

    @staticmethod
    def list_quantities(joints: int) -> tuple[str, ...]:
        """Returns the names of the quantities that can be limited in a part of a run (window).

        They include quantities of each joint, so their number depends on the arm.

        Args:
            joints: Number of joints of the arm, which decides how many quantities such as
                q1_rad exist.
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
    """Replaces the names of joints in expectations by their numbers.

    Expectations for a part of a run (a window) have keys such as q_elbow_rad. This key becomes
    q3_rad if the elbow is the third joint.

    Args:
        written: Windows as their author wrote them.
        joint_names: Names of the joints of each site's arm, in their order.

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
    """Returns a table in which names of joints in the keys are replaced by their numbers.

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
    """Splits a key that names a joint into its prefix, the name and its suffix.

    For example, "q_elbow_rad" is split into "q", "elbow" and "_rad". All parts are empty if the
    key does not name a joint.
    """
    for prefix, suffix in (("q", "_rad"), ("push", "_mean_nm")):
        if key.startswith(f"{prefix}_") and key.endswith(suffix):
            name = key.removeprefix(f"{prefix}_").removesuffix(suffix)
            return prefix, name, suffix
    return "", "", ""


def _find_window_problem(
    window: ExpectWindow, joint_counts: Mapping[str, int]
) -> KeyProblem | None:
    """Returns the reason why no run could satisfy a window of expectations.

    For example, the smallest permitted value may be larger than the largest one.

    Args:
        window: Part of a run with the permitted values of some quantities.
        joint_counts: Number of joints of each site's arm, by the name of the site.

    Returns:
        The key and the reason. None if the window is possible.
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
"""Duration of the last part of a run, to which the keys `end_...` apply, in s."""


class Expect(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True
):
    """Conditions that every run of an experiment must satisfy, for every random seed.

    The command `trilat test` checks them. The error of an arm is e = q_i - q_id, Eq. (9): its
    joint angles q_i minus the position q_id that it should follow. |e| is evaluated for each
    joint separately. "Largest" and "smallest" refer to all arms (or network links), all joints
    and all control periods. If an arm diverges, the run ends there. Only the part before the
    divergence counts, and the run fails unless `stable = false` is expected.

    Attributes:
        stable: True if the run must be stable, False if it must be unstable. A run whose
            stability cannot be decided fails both, see `analysis.run_end`.
        synchronised_by_s: Time from which the largest |e| must stay below `synchronised_rad`
            until the end of the run, in s.
        synchronised_rad: Limit of |e| below which the sites count as synchronised, in rad.
        peak_error_max_rad: Upper limit of the largest |e| of the run.
        peak_error_min_rad: Lower limit of the same quantity.
        rms_error_max_rad: Upper limit of the root mean square of e over the run, for the joint
            with the largest value.
        end_error_max_rad: Upper limit of the largest |e| in the last second.
        end_error_min_rad: Lower limit of the same quantity.
        end_spread_max_rad: Upper limit of the largest difference in the last second between two
            sites' angles of the same joint at the same time, without delay. It is evaluated at
            the ticks of the first site.
        end_pose_rad: Expected joint angles at the last tick, by the name of the site, in rad.
        end_pose_within_rad: Largest permitted deviation from each of these angles, in rad.
        peak_torque_max_nm: Upper limit of the control torque of a joint.
        peak_speed_max_rad_s: Upper limit of the speed of a joint.
        age_max_ms: Upper limit of the age of the sample in use (now minus its send time), from
            the first sample of a link on. A link on which no sample ever comes into use fails.
        mean_age_max_ms: Upper limit of this age averaged over the ticks, for the link with the
            largest average.
        mean_age_min_ms: Lower limit of this average, for the link with the smallest average.
        late_samples_max: Largest permitted number of samples, over all links, that arrived
            after they were due.
        no_gaps: If True, there must be a record of every tick, from 0 to the last tick that any
            site had to compute. If False, gaps are permitted.
        windows: Expectations of parts of the run, see `ExpectWindow`.
        metrics: [smallest, largest] permitted value of any number that `trilat metrics`
            measures, by its key, over the whole run as in `trilat compare`.
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
        """Returns the table of expectations, with indices in place of names of joints.

        An expectation states what a test of the scenario requires of a run. It may apply to a
        window of time and to one joint. The author may name this joint as in the URDF file of
        the arm; the result contains its index.

        Args:
            written: Table `expect` as its author wrote it.
            sites: Complete tables of the sites, by name.
            urdf_texts: Texts of the URDF files, by name.
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
        """True if the experiment states at least one condition that its runs must satisfy.

        A tolerance alone does not count, because it only says how precisely other conditions
        are judged.
        """
        tolerances = {"synchronised_rad": 0.01, "end_pose_within_rad": 0.01}
        return msgspec.structs.replace(self, **tolerances) != Expect()

    def find_problem(self, joint_counts: Mapping[str, int]) -> KeyProblem | None:
        """Returns the reason why no run could satisfy the expectations of an experiment.

        For example, an expected end pose must have as many angles as the arm has joints. The
        problem is reported when the experiment is loaded, and not after a long run.

        Args:
            joint_counts: Number of joints of each site's arm, by the name of the site.

        Returns:
            The reason, with the path of its key below `expect`. None if a run may satisfy them.
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
