"""Validates complete scenarios and converts them to typed objects.

The types of the tables restrict individual keys. This module checks conditions that involve
several keys, for example that a joint starts within its stops. `build_scenario` does both.

`Scenario.check_outside_arms` performs the additional checks required for a live session with
real robots.

Invariant:
    - An error contains the path of the key in the scenario file.
    - Some control laws have requirements that not every scenario satisfies, such as a known arm
      or exactly two sites. If a requirement is not satisfied, the scenario is rejected with the
      reason before anything runs.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from ..core import MAX_LINKS_BYTES, DominanceMatrix, SiteArrays
from ..errors import ScenarioError, count_nouns
from ..fields import TomlTable
from ..laws import LawSettings
from ..own_code import ImportedLaw
from . import operators
from .arms import START_MARGIN_M, START_MARGIN_RAD, TASK_AXES, start_margin
from .change import Change
from .distributions import dotted_key
from .operators import kernel_operators
from .operators.program_hand import ProgramHand
from .refusals import convert_drawn
from .scenario_types import Scenario
from .site_spec import SiteSpec

RANK_TOLERANCE = 1e-6
"""Singular value, relative to the largest, below which a direction counts as immobile."""


def _check_law(name: str, site: SiteSpec, sites: int) -> None:
    """Raises ScenarioError if an arm cannot use its control law.

    This can be the case, for example, because the masses of the arm are unknown. Settings that
    contradict the kind of plant (simulated by the program, simulated by a user's class, or a
    real robot) are also rejected.

    Args:
        name: Name of the site, for error messages.
        site: The site, with its control law and plant.
        sites: Number of sites in the scenario.

    Raises:
        ScenarioError: A condition fails. The error contains the path of the key.
    """
    path = f"sites.{name}"
    law = site.control
    _check_plant(path, site)
    law.check(f"{path}.control", sites)
    if law.plugged and site.task.space != "joints":
        raise ScenarioError(
            f"{law.tag} compares arms joint by joint, but the space of this task is "
            f"{site.task.space!r}: choose adaptive, p_d, pd_d or p_f",
            path=f"{path}.control.law",
        )

    # A law that needs theta is refused for an unknown arm with a reason of its own.
    needs_theta = getattr(law.kind, "needs_theta", False)
    feeds_gravity = getattr(law, "gravity", 0.0) * site.arm.g_m_s2 > 0.0
    if not site.arm.known and not needs_theta and feeds_gravity:
        raise ScenarioError(
            f"{law.tag} computes gravity from the arm's masses, which are unknown (arm.known = "
            "false): set gravity = 0 if the arm compensates gravity itself, set arm.g_m_s2 = 0 "
            "if the arm moves in a horizontal plane, or choose adaptive, which estimates "
            "gravity",
            path=f"{path}.control.gravity",
        )


def _check_plant(path: str, site: SiteSpec) -> None:
    """Raises ScenarioError for settings that only the other kind of plant can have.

    Some settings are reserved for simulated arms, others for real robots.

    Args:
        path: Path of the site, for error messages.
        site: The site.
    """
    external = site.plant != "simulated"
    if not site.arm.known and not external:
        raise ScenarioError(
            "the masses of a simulated arm are always known: set this key to true, or set "
            f"{path}.plant to 'external' for an external arm",
            path=f"{path}.arm.known",
        )
    if site.arm.dead_man and site.plant != "external":
        raise ScenarioError(
            "applies only to an external arm (plant = 'external'): nobody is near a simulated "
            "arm",
            path=f"{path}.arm.dead_man",
        )
    if not external:
        return
    for group in ("hands", "environment"):
        if getattr(site, group):
            raise ScenarioError(
                "applies only to a simulated arm: forces on an external arm, or on a user's "
                "own plant, act outside the program; leave this list out",
                path=f"{path}.{group}",
            )


def build_scenario(resolved: TomlTable) -> Scenario:
    """Converts the complete tables of a scenario to a `Scenario` and validates it.

    If a scenario contains several errors, the order of the checks determines which one is
    reported.

    Args:
        resolved: Tables from `resolve.resolve_scenario`.

    Raises:
        ScenarioError: A value has a wrong type or is out of range, or values contradict each
            other. The error contains the path of the key.
    """
    scenario = convert_drawn(
        table=resolved,
        kind=Scenario,
        path="",
        drawn=resolved["drawn"],
        seed=resolved["seed"],
    )
    _check_joint_space(scenario)
    _check_damping(scenario)
    _check_start_poses(scenario)
    for name in scenario.names:
        _check_limits(scenario, name)
    _check_task_poses(scenario)
    _check_energy_laws(scenario)

    for name, site in scenario.sites.items():
        _check_law(name, site, len(scenario.sites))
        joints = scenario.layout(name).joints
        scenario.channel(name).check_vectors(joints, f"sites.{name}.control")
        _check_actors(site.hands, f"sites.{name}.hands")
        _check_hands(site, f"sites.{name}.hands")
        _check_actors(site.environment, f"sites.{name}.environment")

    _check_received(scenario)
    _check_links(scenario)
    _check_stale_rules(scenario)
    for n, change in enumerate(scenario.timeline):
        change.check_link(f"timeline[{n}]")
    for name in scenario.names:
        check_links_memory(scenario, name)

    joint_counts = {name: model.counts.joints for name, model in scenario.arms.items()}
    problem = scenario.expect.find_problem(joint_counts)
    if problem is not None:
        raise ScenarioError(problem.problem, path=f"expect.{problem.key}")

    timeline = tuple(_normalise_change(change) for change in scenario.timeline)
    return msgspec.structs.replace(scenario, timeline=timeline)


def _normalise_change(change: Change) -> Change:
    """Returns a change with its link formatted like the links of the scenario.

    Authors may write 350 or 350.0. Both must give the same text, so that they are the same
    experiment with the same hash.
    """
    if not change.link:
        return change
    return msgspec.structs.replace(change, to=msgspec.to_builtins(change.after))


def _check_joint_space(scenario: Scenario) -> None:
    """Raises ScenarioError if arms cannot share coordinates, or a law does not support chains.

    All sites share either joint angles or the pose of the end effector. Joint angles can be
    compared only between arms with the same number of joints.

    Args:
        scenario: The scenario.
    """
    joint_counts = {name: model.counts.joints for name, model in scenario.arms.items()}
    spaces = {name: site.task.space for name, site in scenario.sites.items()}
    first = scenario.names[0]

    for name, joints in joint_counts.items():
        if spaces[name] != spaces[first]:
            raise ScenarioError(
                f"is {spaces[name]!r}, but the space of {first} is {spaces[first]!r}: all "
                "sites must use the same space",
                path=f"sites.{name}.task.space",
            )
        if spaces[name] == "joints" and joints != joint_counts[first]:
            raise ScenarioError(
                f"has {count_nouns(joints, 'joint')}, but the arm of {first} has "
                f"{joint_counts[first]}: joint angles are compared one by one, so all arms "
                "need the same number of joints, or a task (task.space)",
                path=f"sites.{name}.arm",
            )
        law = scenario.sites[name].control
        if spaces[name] != "joints" and law.needs_joint_space:
            raise ScenarioError(
                f"{law.tag} computes the damping of the joints from a stiffness per joint, but "
                f"the space of {name} is {spaces[name]!r}: choose p_d or pd_d",
                path=f"sites.{name}.control.law",
            )
        if scenario.arms[name].chain is not None and law.planar:
            raise ScenarioError(
                f"{law.tag} uses the regressor of the planar two-link arm, but this arm is a "
                "chain: choose adaptive",
                path=f"sites.{name}.control.law",
            )


def _check_links(scenario: Scenario) -> None:
    """Raises ScenarioError if a link, or the delayed view of a user, has contradictory keys."""
    links = {f"links.{name}": link for name, link in scenario.links.items()}
    views = {
        f"sites.{name}.view": site.view for name, site in scenario.sites.items() if site.view
    }

    for path, link in {**links, **views}.items():
        problem = link.find_problem()
        if problem is not None:
            raise ScenarioError(problem.problem, path=f"{path}.{problem.key}")
        if path in views and link.measured:
            raise ScenarioError(
                "cannot be 'measured': pictures are not sent over the network, so their delay "
                "cannot be measured",
                path=f"{path}.model",
            )


def _check_damping(scenario: Scenario) -> None:
    """Raises ScenarioError if a damping gain is too large for a light joint of a chain.

    A damping torque -K qd is held for one control period h. A single joint with inertia M then
    oscillates from period to period if K h / M >= 1 with the second-order scheme, or K h / M >=
    2 with the digital scheme. For several joints, K / M is replaced with the largest eigenvalue
    of K M^-1, computed at the start pose.
    """
    for name, model in scenario.arms.items():
        site = scenario.sites[name]
        if model.chain is None or isinstance(site.control, ImportedLaw) or not site.arm.known:
            continue

        gains = site.control.gains(model.theta)
        # The robust term acts as a damping rho / width inside its boundary layer.
        robust = np.divide(gains.rho, gains.width)
        damping = np.zeros(model.counts.joints) + gains.Kp + gains.d + robust
        damping += gains.Kd if site.task.space == "joints" else 0.0

        # K M^-1 has the eigenvalues of the symmetric matrix K^(1/2) M^-1 K^(1/2).
        root = np.sqrt(damping)
        inverse_inertia = np.linalg.inv(model.inertia(np.array(site.q0_rad)))
        rates_1_s, modes = np.linalg.eigh(root * inverse_inertia * root[:, None])

        limit = 1.0 if scenario.scheme == "second_order" else 2.0
        ratio = rates_1_s[-1] / site.rate_hz
        if ratio >= limit:
            # The mode with the largest eigenvalue moves this joint most.
            worst = int(np.argmax(np.abs(modes[:, -1])))
            raise ScenarioError(
                f"damps joint {model.joint_names[worst]} by {damping[worst]:g} N m s/rad in "
                f"total, {ratio / limit:.3g} times what the inertia of the joint allows at "
                f"{site.rate_hz} Hz: lower Kp, Kd or d of this joint, raise rate_hz, or state "
                "the drive's armature_kg_m2",
                path=f"sites.{name}.control",
            )


def _check_received(scenario: Scenario) -> None:
    """Raises ScenarioError if an arm receives vectors of one name but different lengths.

    A control law may send additional named vectors to the other arms. A receiver stores vectors
    of the same name in one array, so their lengths must agree.
    """
    for site in scenario.names:
        first_senders: dict[str, tuple[str, int]] = {}
        for peer in scenario.peers(site):
            for name, _, length, _ in scenario.channel(peer).vectors:
                first, first_length = first_senders.setdefault(name, (peer, length))
                if first_length != length:
                    raise ScenarioError(
                        f"has {count_nouns(length, 'number')}, but {name} of {first} has "
                        f"{first_length}, and {site} receives both: give the two vectors the "
                        "same length or different names",
                        path=f"sites.{peer}.control.sends.{name}",
                    )


def _check_energy_laws(scenario: Scenario) -> None:
    """Raises ScenarioError if only some arms have a law that keeps an energy account.

    Such a law proves stability by accounting for the energy that enters and leaves each network
    link, which requires both ends to do so. It may have further conditions on the integration
    scheme and the rates of the control loops.
    """
    laws = {name: site.control for name, site in scenario.sites.items()}
    rates_hz = {name: site.rate_hz for name, site in scenario.sites.items()}
    for name, law in laws.items():
        if law.books_energy:
            _check_energy_law(scenario.scheme, name, laws, rates_hz)


def _check_energy_law(
    scheme: str, name: str, laws: dict[str, LawSettings], rates_hz: dict[str, int]
) -> None:
    """Raises ScenarioError if the other arms do not fit an arm whose law accounts for energy.

    For example, they may use another law, or control loops with other rates.

    Args:
        scheme: Integration scheme of the scenario.
        name: Name of the site whose law accounts for energy.
        laws: Mapping from site name to law.
        rates_hz: Mapping from site name to tick rate, in Hz.
    """
    law = laws[name]
    tag = law.tag
    for other_name, other_law in laws.items():
        if type(other_law) is not type(law):
            raise ScenarioError(
                f"{name} has {tag}, which all sites must have: choose {tag} here, or another "
                f"law at {name}",
                path=f"sites.{other_name}.control.law",
            )
    if scheme not in law.kind.schemes:
        raise ScenarioError(
            f"is {scheme!r}, but {tag} computes energies for a torque that is held during a "
            "tick: choose 'digital'",
            path="scheme",
        )
    problem = law.find_problem(rates_hz)
    if problem is not None:
        raise ScenarioError(problem.problem, path=f"sites.{name}.{problem.key}")


def _check_start_poses(scenario: Scenario) -> None:
    """Raises ScenarioError if a joint starts too far beyond one of its mechanical stops.

    The largest permitted distance is `start_margin`.

    Args:
        scenario: The scenario.
    """
    for name, model in scenario.arms.items():
        if model.chain is None:
            continue
        q0_rad = scenario.sites[name].q0_rad
        for n, (joint, start) in enumerate(zip(model.chain.joints, q0_rad, strict=False)):
            # `widen_stops` has moved the stops that lie within the margin of the start pose.
            if joint.lower <= start <= joint.upper:
                continue
            unit = "m" if joint.prismatic else "rad"
            path = f"sites.{name}.q0_rad[{n}]"
            is_drawn = dotted_key(path) in scenario.drawn
            drawn = f", drawn with seed {scenario.seed}" if is_drawn else ""
            raise ScenarioError(
                f"is {start:g} {unit}{drawn}, beyond a stop of joint {model.joint_names[n]}, "
                f"which moves from {joint.lower:g} to {joint.upper:g} {unit}: start at most "
                f"{start_margin(joint):g} {unit} beyond the stop, or set stops = false",
                path=path,
            )


def _check_limits(scenario: Scenario, name: str) -> None:
    """Raises ScenarioError for position limits that are inconsistent or exclude the start pose.

    Limits that can never have an effect are also rejected.

    Args:
        scenario: The scenario.
        name: Name of the site.
    """
    site = scenario.sites[name]
    path = f"sites.{name}.limits"
    limits = scenario.motion_limits(name)
    low = limits.q_min
    high = limits.q_max

    for key in ("q_min_rad", "q_max_rad"):
        if getattr(site.limits, key) is not None and site.on_stale.action != "glide":
            if name in scenario.outside:  # the limits of a real robot must stay
                jump = site.describe_jump()
                raise ScenarioError(
                    jump.problem, path=f"sites.{name}.{jump.key}", source=scenario.name
                )
            raise ScenarioError(
                "applies only with on_stale.action = 'glide', but the action is "
                f"{site.on_stale.action!r}",
                path=f"{path}.{key}",
            )
    if not np.all(np.less(low, high)):
        raise ScenarioError("must be above q_min_rad for every joint", path=f"{path}.q_max_rad")

    # `low` and `high` already include the margin for a start beyond the written limits.
    start = np.array(site.q0_rad)
    is_beyond = (start < low) | (start > high)
    if np.any(is_beyond):
        joint = int(np.argmax(is_beyond))
        raise ScenarioError(
            f"is {start[joint]:g} rad, outside the limits q_min_rad and q_max_rad: start at "
            f"most {START_MARGIN_RAD:g} rad (for a sliding joint, {START_MARGIN_M:g} m) "
            "outside the limits",
            path=f"sites.{name}.q0_rad[{joint}]",
        )


def _check_task_poses(scenario: Scenario) -> None:
    """Checks the start poses of all arms that follow each other's end effectors."""
    for name, model in scenario.arms.items():
        if model.shares_pose:
            _check_task_pose(scenario, name)


def _check_task_pose(scenario: Scenario, name: str) -> None:
    """Raises ScenarioError if the end effector cannot move along all axes that it follows.

    The Jacobian J of the end effector, evaluated at the start pose, has one row per followed
    axis. A row of zeros is an axis along which no joint moves the end effector. If J does not
    have full row rank, the pose is singular: the end effector cannot move along some
    combination of the axes.

    Args:
        scenario: The scenario.
        name: Name of the site.

    Raises:
        ScenarioError: The end effector cannot move along an axis or a combination of axes.
    """
    model = scenario.arms[name]
    q0_rad = scenario.sites[name].q0_rad
    is_followed = np.array(model.axes) > 0.0
    followed = [axis for axis, follows in zip(TASK_AXES, is_followed, strict=False) if follows]
    J = model.task_jacobian(q0_rad)[is_followed]
    joints = model.counts.joints
    path = f"sites.{name}.task.axes"

    for axis, row in zip(followed, J, strict=True):
        if np.abs(row).max() < RANK_TOLERANCE:
            raise ScenarioError(
                f"has {axis}, along which no joint moves the end effector from its start pose: "
                "name only axes that the site can follow, or choose another start pose "
                "(q0_rad)",
                path=path,
            )
    if len(followed) > joints:
        raise ScenarioError(
            f"follows {', '.join(followed)} with {count_nouns(joints, 'joint')}: name "
            f"at most {count_nouns(joints, 'axis')}",
            path=path,
        )

    directions, singular_values, _ = np.linalg.svd(J)
    if singular_values[-1] < RANK_TOLERANCE * singular_values[0]:
        # The last left singular vector is the direction in which the end effector cannot move.
        lost_direction = " + ".join(
            f"{component:.2g} {axis}"
            for component, axis in zip(directions[:, -1], followed, strict=True)
            if abs(component) > RANK_TOLERANCE
        )
        raise ScenarioError(
            f"is a singular pose: the end effector cannot move along {lost_direction}; bend a "
            "joint, or follow fewer axes (task.axes)",
            path=f"sites.{name}.q0_rad",
        )


def _check_actors(
    actors: Sequence[operators.Operator | operators.Environment], path: str
) -> None:
    """Raises ScenarioError if the settings of an operator or environment are contradictory.

    Args:
        actors: The operators or environments of one site.
        path: Path of their list, for error messages.
    """
    for n, actor in enumerate(actors):
        problem = actor.find_problem()
        if problem is not None:
            raise ScenarioError(problem.problem, path=f"{path}[{n}].{problem.key}")


def _check_hands(site: SiteSpec, path: str) -> None:
    """Raises ScenarioError if an operator cannot move the arm as the scenario specifies.

    An arm has at most one live operator, and only if it is simulated by the program itself. A
    user's program acts in every n-th control period, so its rate must divide the rate of the
    control loop.

    Args:
        site: The site.
        path: Path of the list of operators, for error messages.
    """
    live_indices = [
        n for n, hand in enumerate(site.hands) if isinstance(hand, kernel_operators.LiveHand)
    ]
    if live_indices and site.plant != "simulated":
        raise ScenarioError(
            "cannot be a live hand, because the arm is external or simulated by a user's own "
            "plant: the torque of a person who holds such an arm is measured, as tau_x",
            path=f"{path}[{live_indices[0]}].kind",
        )
    if len(live_indices) > 1:
        raise ScenarioError(
            f"is a second live hand besides {path}[{live_indices[0]}]; an arm can have only "
            "one live hand",
            path=f"{path}[{live_indices[1]}].kind",
        )
    for n, hand in enumerate(site.hands):
        if isinstance(hand, ProgramHand) and site.rate_hz % hand.rate_hz:
            raise ScenarioError(
                f"must divide the site's tick rate, {site.rate_hz} Hz, but is {hand.rate_hz}",
                path=f"{path}[{n}].rate_hz",
            )


def check_links_memory(scenario: Scenario, site: str) -> None:
    """Raises ScenarioError if messages waiting on the links would need too much memory.

    A message waits at the receiver until its simulated delay has passed. The memory grows with
    the delay, the rate of the control loop and the number of arms, and is limited to
    `MAX_LINKS_BYTES`.

    Args:
        scenario: The scenario, with its links and tick rates.
        site: Name of the site that receives the samples.

    Raises:
        ScenarioError: The limit is exceeded. The error contains the path of the site.
    """
    setup = scenario.setup(site)
    size_bytes = SiteArrays.count_link_bytes(setup)
    if size_bytes > MAX_LINKS_BYTES:
        raise ScenarioError(
            f"the links of this site would need {size_bytes / 2**20:.0f} MiB, but at most "
            f"{MAX_LINKS_BYTES >> 20} MiB are allowed: shorten the delays, lower rate_hz, or "
            "use fewer sites",
            path=f"sites.{site}",
        )


def _check_stale_rules(scenario: Scenario) -> None:
    """Raises ScenarioError if a stale rule would be triggered in normal operation.

    A peer counts as silent if its last sample is too old. The interval between two samples, and
    the fixed delay of the link, must be below the limit. Otherwise, the receiver would wait
    during the entire run.

    Args:
        scenario: The scenario.
    """
    _check_lost(scenario)
    for name, site in scenario.sites.items():
        rule = site.on_stale
        peers = scenario.peers(name)

        slowest_hz = min(scenario.sites[other].rate_hz for other in (name, *peers))
        if rule.action == "glide" and rule.silence_ms < 2e3 / slowest_hz:
            raise ScenarioError(
                f"must be at least {2e3 / slowest_hz:g} ms, two periods of {slowest_hz} Hz, "
                f"but is {rule.silence_ms:g}",
                path=f"sites.{name}.on_stale.silence_ms",
            )

        # Only these two rules compare the age of samples with `age_ms`.
        if rule.action not in ("hold", "brake"):
            continue
        for peer in peers:
            link = scenario.links[f"{peer}->{name}"]
            constant_ms = link.constant_delay_ms or 0.0
            delay_ms = max(link.playout_ms, constant_ms)
            follows = scenario.dominance[name].get(peer, 0.0) > 0.0
            if follows and delay_ms >= rule.age_ms:
                raise ScenarioError(
                    f"must be above the delay of {peer}->{name}, {delay_ms:g} ms, but is "
                    f"{rule.age_ms:g}: otherwise the site would never follow {peer}",
                    path=f"sites.{name}.on_stale.age_ms",
                )


def _check_lost(scenario: Scenario) -> None:
    """Raises ScenarioError if the rule "degrade" is set but no site can lose a master.

    Under this rule, a site continues without a master that has fallen silent, which requires
    another site for it to follow.

    Args:
        scenario: The scenario.
    """
    degrading = [
        name for name, site in scenario.sites.items() if site.on_stale.on_lost == "degrade"
    ]
    for name in degrading:
        if scenario.sites[name].on_stale.action != "glide":
            raise ScenarioError(
                "degrade needs on_stale.action = 'glide': otherwise a reference would jump",
                path=f"sites.{name}.on_stale.on_lost",
            )
    if degrading and not any(_can_lose_master(scenario, name) for name in degrading):
        raise ScenarioError(
            "degrade has no effect, because no site can go on without a master: that is "
            "possible only if the site also follows another site, and if the remaining sites "
            "all reach each other (through shares above 0)",
            path=f"sites.{degrading[0]}.on_stale.on_lost",
        )


def _can_lose_master(scenario: Scenario, name: str) -> bool:
    """Returns True if a site can continue after some master that it follows has fallen silent.

    The site must also follow another site. The remaining sites must all follow each other,
    directly or through others (irreducible dominance matrix).

    Args:
        scenario: The scenario.
        name: Name of the site.
    """
    alpha = scenario.alpha
    shares = alpha[scenario.names.index(name)]
    for n, site in enumerate(scenario.sites.values()):
        if site.role != "master":
            continue
        # the dominance matrix without the row and the column of this master
        remaining = np.delete(np.delete(alpha, n, 0), n, 1)
        follows_others = shares[n] > 0.0 and shares.sum() > shares[n]
        if follows_others and DominanceMatrix(remaining).is_irreducible:
            return True
    return False
