"""Validate a resolved scenario: its tables become types, and wrong values become errors.

`build_scenario` converts the tables and runs every check that no range of a single key can
express. `refuse_external_arms`, `refuse_live_only` and `check_outside_arms` are for callers
that need more than a valid scenario: a run in virtual time, or a live session with robots.

Invariant:
    - An error names the path of the key.
    - If a law needs something that a scenario lacks (knowledge of the arm, a number of sites),
      the scenario is refused before anything runs, with the reason.
"""

import functools
import operator
from collections.abc import Collection, Sequence
from typing import Any, get_args

import msgspec
import numpy as np

from ..core.dominance import is_irreducible
from ..core.site_arrays import MAX_LINKS_BYTES, links_bytes, needed_pages
from ..errors import ScenarioError, count_nouns
from ..fields import TomlTable, reword_problem, split_refusal
from ..files import find_page
from ..laws.interface import LawSettings
from ..laws.sent_vectors import check_sends
from . import operators
from .arms import START_MARGIN_M, START_MARGIN_RAD, TASK_AXES, start_margin
from .delay_models import LinkBase
from .delay_models.kernel_delays import ConstantDelay, TraceDelay
from .distributions import dotted_key
from .expect import find_expect_problem
from .imported_code import ImportedLaw
from .operators import kernel_operators
from .operators.program_hand import ProgramHand
from .scenario_types import Change, OnStale, Scenario, SiteSpec

RANK_TOLERANCE = 1e-6
"""Singular values below this share of the largest one belong to directions without motion."""


def refuse_external_arms(scenario: Scenario, exempt: Collection[str] = ()) -> None:
    """Refuses arms that the program does not simulate.

    Args:
        scenario: the scenario.
        exempt: sites whose arms may be external, because their motion is known from a log.

    Raises:
        ScenarioError: an arm of another site is external.
    """
    for name in scenario.external:
        if name in exempt:
            continue
        problem = (
            "is a user's own plant, which runs in `trilat sim` and live, but not here: "
            "plant = 'simulated' uses the arm of the scenario"
        )
        if name in scenario.outside:
            problem = (
                "is external: that arm is outside of the program, and such a scenario runs "
                "live only; plant = 'simulated' runs it in virtual time"
            )
        raise ScenarioError(problem, path=f"sites.{name}.plant", source=scenario.name)


OUTSIDE_LIMITS = ("tau_rate_limit_nm_s", "qd_des_limit_rad_s", "q_min_rad", "q_max_rad")
"""Limits that an arm outside of the program must have besides the usual limits."""


def check_outside_arms(scenario: Scenario) -> None:
    """Refuses arms outside of the program that lack limits or the stale rule "glide".

    This is checked before a session, and not for every scenario, because logs of earlier
    versions may lack these keys.

    Raises:
        ScenarioError: with the path of the first key that is missing or wrong.
    """
    for name in scenario.outside:
        site = scenario.sites[name]
        for key in OUTSIDE_LIMITS:
            if getattr(site.limits, key) is None:
                raise ScenarioError(
                    "is missing: an arm outside of the program needs limits of its position "
                    "(q_min_rad, q_max_rad), its reference (qd_des_limit_rad_s) and the rate "
                    "of its torque (tau_rate_limit_nm_s), besides tau_limit_nm and "
                    "qd_limit_rad_s",
                    path=f"sites.{name}.limits.{key}",
                    source=scenario.name,
                )
        if site.on_stale.action != "glide":
            raise ScenarioError(
                f"is {site.on_stale.action!r}, and an arm outside of the program needs "
                "'glide': its site then waits, holds and stops without a jump "
                f"({find_page('links.md')})",
                path=f"sites.{name}.on_stale.action",
                source=scenario.name,
            )


def refuse_live_only(scenario: Scenario) -> None:
    """Refuses a scenario that only a live session can run.

    Raises:
        ScenarioError: an arm is external; or a link has the delay of the real network
            ("measured"), which would be one tick in virtual time.
    """
    refuse_external_arms(scenario)
    if scenario.measured:
        measured_links = [name for name, link in scenario.links.items() if link.measured]
        path = f"links.{measured_links[0]}.model" if measured_links else "timeline"
        raise ScenarioError(
            "is measured: that is the delay of a real network, and such a scenario runs live "
            "only; give it a model, as in link.model=constant and link.delay_ms=50",
            path=path,
            source=scenario.name,
        )


def check_law(name: str, site: SiteSpec, sites: int) -> None:
    """Refuses a law that its site cannot carry out, and an arm that contradicts its plant.

    Args:
        name: the name of the site.
        site: the site.
        sites: the number of sites of the scenario.

    Raises:
        ScenarioError: with the path of the key.
    """
    path = f"sites.{name}"
    law = site.control
    _check_plant(path, site)
    law.check(f"{path}.control", sites)
    if law.plugged and site.task.space != "joints":
        raise ScenarioError(
            f"{law.tag} compares joint by joint, and the space of this task is "
            f"{site.task.space!r}: choose adaptive, p_d, pd_d or p_f there",
            path=f"{path}.control.law",
        )
    learns_arm = getattr(law.kind, "needs_theta", False)
    feeds_gravity = getattr(law, "gravity", 0.0) * site.arm.g_m_s2 > 0.0
    if not site.arm.known and not learns_arm and feeds_gravity:
        raise ScenarioError(
            f"{law.tag} takes gravity from the arm's masses, which are unknown (arm.known = "
            "false): set gravity = 0 if the arm carries itself, arm.g_m_s2 = 0 if it moves in "
            "a horizontal plane, or choose adaptive, which learns it",
            path=f"{path}.control.gravity",
        )


def _check_plant(path: str, site: SiteSpec) -> None:
    """Refuses keys that contradict whether the arm is simulated or outside of the program."""
    external = site.plant != "simulated"
    if not site.arm.known and not external:
        raise ScenarioError(
            "a simulated arm moves by its masses: leave it true, or set plant = 'external' for "
            "an arm outside of the program",
            path=f"{path}.arm.known",
        )
    if site.arm.dead_man and site.plant != "external":
        raise ScenarioError(
            "is for an arm outside of the program (plant = 'external'): nobody is near a "
            "simulated one",
            path=f"{path}.arm.dead_man",
        )
    if not external:
        return
    for group in ("hands", "environment"):
        if getattr(site, group):
            raise ScenarioError(
                "an arm that is outside of the program, or a user's own plant, is pushed "
                "there: "
                "leave them out",
                path=f"{path}.{group}",
            )


def _list_literals(hint: Any) -> tuple[str, ...]:
    """Returns the literal texts in a type, in a union with other types or not."""
    literals: tuple[str, ...] = ()
    for argument in get_args(hint):
        literals += (argument,) if isinstance(argument, str) else _list_literals(argument)
    return literals


_CHOICES = {
    key: _list_literals(kind.__annotations__[key])
    for kind, key in (
        (Scenario, "scheme"),
        (SiteSpec, "role"),
        (SiteSpec, "plant"),
        (LinkBase, "order"),
        (TraceDelay, "at_end"),
        (OnStale, "action"),
        (OnStale, "on_lost"),
    )
}
"""The texts that a key may have, by the name of the key."""


def build_scenario(resolved: TomlTable) -> Scenario:
    """Returns the scenario of resolved tables.

    Raises:
        ScenarioError: a value has a wrong type or range, or values contradict each other; with
            the path of the key.
    """
    scenario = _convert_scenario(resolved)
    _check_joint_space(scenario)
    _check_damping(scenario)
    _check_start_poses(scenario)
    for name in scenario.names:
        _check_limits(scenario, name)
    _check_task_poses(scenario)
    _check_energy_laws(scenario)
    for name, site in scenario.sites.items():
        check_law(name, site, len(scenario.sites))
        joints = scenario.layout(name).joints
        check_sends(scenario.channel(name), joints, f"sites.{name}.control")
        _check_actors(site.hands, f"sites.{name}.hands")
        _check_hands(site, f"sites.{name}.hands")
        _check_actors(site.environment, f"sites.{name}.environment")
    _check_received(scenario)
    _check_links(scenario)
    _check_stale_rules(scenario)
    for n, change in enumerate(scenario.timeline):
        check_change(change, f"timeline[{n}]")
    for name in scenario.names:
        check_links_memory(scenario, name)
    joint_counts = {name: model.counts.joints for name, model in scenario.arms.items()}
    problem = find_expect_problem(scenario.expect, joint_counts)
    if problem is not None:
        raise ScenarioError(problem.problem, path=f"expect.{problem.key}")
    timeline = tuple(_normalise_change(change) for change in scenario.timeline)
    return msgspec.structs.replace(scenario, timeline=timeline)


def _convert_scenario(resolved: TomlTable) -> Scenario:
    """Returns the struct of resolved tables; an error says if the number was drawn."""
    try:
        return msgspec.convert(resolved, Scenario)
    except msgspec.ValidationError as error:
        problem, path = split_refusal(error)
        key_path = _name_key(resolved, path.strip("."))
        problem = _reword(problem, key_path)
        drawn = resolved.get("drawn", {}).get(dotted_key(key_path))
        if drawn:
            problem += f"; {drawn['value']:g} was drawn with seed {resolved['seed']}"
        raise ScenarioError(problem, path=key_path) from None


def _normalise_change(change: Change) -> Change:
    """Returns a change whose link is written as in `Scenario.links`.

    350 and 350.0 are then the same experiment.
    """
    if not change.link:
        return change
    return msgspec.structs.replace(change, to=msgspec.to_builtins(change.after))


def _check_joint_space(scenario: Scenario) -> None:
    """Refuses arms that share different coordinates, and laws that do not support chains."""
    joint_counts = {name: model.counts.joints for name, model in scenario.arms.items()}
    spaces = {name: site.task.space for name, site in scenario.sites.items()}
    first = scenario.names[0]
    for name, joints in joint_counts.items():
        if spaces[name] != spaces[first]:
            raise ScenarioError(
                f"is {spaces[name]!r}, and that of {first} is {spaces[first]!r}: all sites "
                "share one space",
                path=f"sites.{name}.task.space",
            )
        if spaces[name] == "joints" and joints != joint_counts[first]:
            raise ScenarioError(
                f"its arm has {count_nouns(joints, 'joint')}, and that of {first} has "
                f"{joint_counts[first]}: joint angles are compared one by one, so all arms "
                "need the same number of joints, or a task (task.space)",
                path=f"sites.{name}.arm",
            )
        law = scenario.sites[name].control
        if scenario.arms[name].chain is not None and law.planar:
            raise ScenarioError(
                f"{law.tag} has the regressor of the planar arm of two links, and this arm is "
                "a chain: choose adaptive",
                path=f"sites.{name}.control.law",
            )


def _check_links(scenario: Scenario) -> None:
    """Refuses links, and views of users, whose keys contradict each other."""
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
                "is 'measured', and no network carries a picture", path=f"{path}.model"
            )


def _check_damping(scenario: Scenario) -> None:
    """Refuses gains that a light joint of a chain cannot take.

    A torque -K qd that is held over a period h makes a single joint of inertia M swing from
    tick to tick if K h / M >= 1 (second-order scheme) or 2 (digital scheme). For several joints
    K / M is the largest eigenvalue of K M^-1, here in the start pose.
    """
    for name, model in scenario.arms.items():
        site = scenario.sites[name]
        if model.chain is None or isinstance(site.control, ImportedLaw) or not site.arm.known:
            continue
        gains = site.control.gains(model.theta)
        robust = np.divide(gains.rho, gains.width)
        damping = np.zeros(model.counts.joints) + gains.Kp + gains.d + robust
        damping += gains.Kd if site.task.space == "joints" else 0.0
        # K M^-1 has the eigenvalues of the symmetric K^(1/2) M^-1 K^(1/2).
        root = np.sqrt(damping)
        inverse_inertia = np.linalg.inv(model.inertia(np.array(site.q0_rad)))
        rates_1_s, modes = np.linalg.eigh(root * inverse_inertia * root[:, None])
        limit = 1.0 if scenario.scheme == "second_order" else 2.0
        ratio = rates_1_s[-1] / site.rate_hz
        if ratio >= limit:
            worst = int(np.argmax(np.abs(modes[:, -1])))
            raise ScenarioError(
                f"damps joint {model.joint_names[worst]} by {damping[worst]:g} N m s/rad in "
                f"all, {ratio / limit:.3g} times what its inertia can take at {site.rate_hz} "
                "Hz: lower Kp, Kd or d there, raise rate_hz, or state the drive's "
                "armature_kg_m2",
                path=f"sites.{name}.control",
            )


def _check_received(scenario: Scenario) -> None:
    """Refuses vectors of one name and different lengths that a site receives from its peers."""
    for site in scenario.names:
        senders: dict[str, tuple[str, int]] = {}
        for peer in scenario.peers(site):
            for name, _, length, _ in scenario.channel(peer).vectors:
                first, first_length = senders.setdefault(name, (peer, length))
                if first_length != length:
                    raise ScenarioError(
                        f"has {count_nouns(length, 'number')}, and {name} of {first} has "
                        f"{first_length}; {site} gets both: give them one length or two names",
                        path=f"sites.{peer}.control.sends.{name}",
                    )


def _check_energy_laws(scenario: Scenario) -> None:
    """Refuses sites that do not all have the same law where a law keeps account of energy.

    Such a law may have further conditions on the scheme and the tick rates of all sites.
    """
    laws = {name: site.control for name, site in scenario.sites.items()}
    rates_hz = {name: site.rate_hz for name, site in scenario.sites.items()}
    for name, law in laws.items():
        if law.books_energy:
            _check_energy_law(scenario.scheme, name, laws, rates_hz)


def _check_energy_law(
    scheme: str, name: str, laws: dict[str, LawSettings], rates_hz: dict[str, int]
) -> None:
    """Refuses a law at site `name` that keeps account of energy and whose conditions fail."""
    law = laws[name]
    tag = law.tag
    for other_name, other_law in laws.items():
        if type(other_law) is not type(law):
            raise ScenarioError(
                f"{name} has {tag}, which all sites must have: choose {tag} here, or another "
                "law "
                f"at {name}",
                path=f"sites.{other_name}.control.law",
            )
    if scheme not in law.kind.schemes:
        raise ScenarioError(
            f"is {scheme!r}, and {tag} computes energies for a torque that is held during a "
            "tick: choose 'digital'",
            path="scheme",
        )
    problem = law.find_problem(rates_hz)
    if problem is not None:
        raise ScenarioError(problem.problem, path=f"sites.{name}.{problem.key}")


def _check_start_poses(scenario: Scenario) -> None:
    """Refuses joints of chains that start farther beyond a stop than the margin."""
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
                f"{start_margin(joint):g} {unit} beyond, or set stops = false",
                path=path,
            )


def _check_limits(scenario: Scenario, name: str) -> None:
    """Refuses limits of position that leave no room, do nothing or exclude the start."""
    site = scenario.sites[name]
    path = f"sites.{name}.limits"
    limits = scenario.motion_limits(name)
    low = limits.q_min
    high = limits.q_max
    for key in ("q_min_rad", "q_max_rad"):
        if getattr(site.limits, key) is not None and site.on_stale.action != "glide":
            raise ScenarioError(
                "applies only with on_stale.action = 'glide', and here that is "
                f"{site.on_stale.action!r}",
                path=f"{path}.{key}",
            )
    if not np.all(np.less(low, high)):
        raise ScenarioError("must be above q_min_rad everywhere", path=f"{path}.q_max_rad")
    start = np.array(site.q0_rad)
    is_beyond = (start < low) | (start > high)
    if np.any(is_beyond):
        joint = int(np.argmax(is_beyond))
        raise ScenarioError(
            f"is {start[joint]:g} rad, beyond q_min_rad or q_max_rad: start at most "
            f"{START_MARGIN_RAD:g} rad ({START_MARGIN_M:g} m of a sliding joint) beyond",
            path=f"sites.{name}.q0_rad[{joint}]",
        )


def _check_task_poses(scenario: Scenario) -> None:
    """Refuses task axes along which an end effector cannot move, and singular start poses."""
    for name, model in scenario.arms.items():
        if model.shares_pose:
            _check_task_pose(scenario, name)


def _check_task_pose(scenario: Scenario, name: str) -> None:
    """Refuses the task axes of a site if its Jacobian in the start pose is rank-deficient."""
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
                "name the axes that the site shall follow, or start elsewhere (q0_rad)",
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
        # The last left singular vector is the direction that the end effector cannot move in.
        lost_direction = " + ".join(
            f"{component:.2g} {axis}"
            for component, axis in zip(directions[:, -1], followed, strict=True)
            if abs(component) > RANK_TOLERANCE
        )
        raise ScenarioError(
            f"is a singular pose: its end effector cannot move along {lost_direction}; bend a "
            "joint, or follow fewer axes (task.axes)",
            path=f"sites.{name}.q0_rad",
        )


def _check_actors(
    actors: Sequence[operators.Operator | operators.Environment], path: str
) -> None:
    """Refuses operators or environments whose keys contradict each other."""
    for n, actor in enumerate(actors):
        problem = actor.find_problem()
        if problem is not None:
            raise ScenarioError(problem.problem, path=f"{path}[{n}].{problem.key}")


def _check_hands(site: SiteSpec, path: str) -> None:
    """Refuses hands of a site that nobody could hold, or that act between its ticks.

    An arm has at most one live hand, and only if the program simulates the arm. The rate of a
    hand that is a program divides the tick rate of the site.
    """
    live_hands = [
        n for n, hand in enumerate(site.hands) if isinstance(hand, kernel_operators.LiveHand)
    ]
    if live_hands and site.plant != "simulated":
        raise ScenarioError(
            "is a live hand, and the arm is outside of the program, or a user's own plant: the "
            "torque of a person who holds such an arm is measured, as tau_x",
            path=f"{path}[{live_hands[0]}].kind",
        )
    if len(live_hands) > 1:
        raise ScenarioError(
            f"is a second live hand besides {path}[{live_hands[0]}]; an arm has one",
            path=f"{path}[{live_hands[1]}].kind",
        )
    for n, hand in enumerate(site.hands):
        if isinstance(hand, ProgramHand) and site.rate_hz % hand.rate_hz:
            raise ScenarioError(
                f"must divide the site's tick rate, {site.rate_hz} Hz, is {hand.rate_hz}",
                path=f"{path}[{n}].rate_hz",
            )


def check_links_memory(scenario: Scenario, site: str) -> None:
    """Refuses links of a site whose delays would take more memory than `MAX_LINKS_BYTES`.

    Raises:
        ScenarioError: with the site's path.
    """
    setup = scenario.setup(site)
    size_bytes = links_bytes(setup, needed_pages(setup))
    if size_bytes > MAX_LINKS_BYTES:
        raise ScenarioError(
            f"its links would take {size_bytes / 2**20:.0f} MiB, at most "
            f"{MAX_LINKS_BYTES >> 20} MiB are allowed: shorten the delays, lower rate_hz, or "
            "have fewer sites",
            path=f"sites.{site}",
        )


def _check_stale_rules(scenario: Scenario) -> None:
    """Refuses stale rules under which a site would hold in every run.

    Tick periods alone must not make a peer silent, and the fixed delay of a link alone must not
    make its samples too old.
    """
    _check_lost(scenario)
    for name, site in scenario.sites.items():
        rule = site.on_stale
        peers = scenario.peers(name)
        slowest_hz = min(scenario.sites[other].rate_hz for other in (name, *peers))
        if rule.action == "glide" and rule.silence_ms < 2e3 / slowest_hz:
            raise ScenarioError(
                f"must be at least {2e3 / slowest_hz:g} ms, two periods of {slowest_hz} Hz, "
                f"is {rule.silence_ms:g}",
                path=f"sites.{name}.on_stale.silence_ms",
            )
        if rule.action not in ("hold", "brake"):
            continue
        for peer in peers:
            link = scenario.links[f"{peer}->{name}"]
            constant_ms = link.delay_ms if isinstance(link, ConstantDelay) else 0.0
            delay_ms = max(link.playout_ms, constant_ms)
            follows = scenario.dominance[name].get(peer, 0.0) > 0.0
            if follows and delay_ms >= rule.age_ms:
                raise ScenarioError(
                    f"must be above the {delay_ms:g} ms of {peer}->{name}, is {rule.age_ms:g}: "
                    f"the site would never follow {peer}",
                    path=f"sites.{name}.on_stale.age_ms",
                )


def _check_lost(scenario: Scenario) -> None:
    """Refuses the rule "degrade" where no site can go on without any of the masters."""
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
            "no master can be lost: a site goes on without a master only if it follows another "
            "site as well, and if the remaining sites all reach each other (through shares "
            "above 0)",
            path=f"sites.{degrading[0]}.on_stale.on_lost",
        )


def _can_lose_master(scenario: Scenario, name: str) -> bool:
    """True if a site can go on without a master that it follows.

    The site must follow another site as well, and the remaining sites must all reach each
    other.
    """
    alpha = scenario.alpha
    shares = alpha[scenario.names.index(name)]
    for n, site in enumerate(scenario.sites.values()):
        if site.role != "master":
            continue
        remaining = np.delete(np.delete(alpha, n, 0), n, 1)
        follows_others = shares[n] > 0.0 and shares.sum() > shares[n]
        if follows_others and is_irreducible(remaining):
            return True
    return False


def check_change(change: Change, path: str) -> None:
    """Refuses a change of a link after which the link is not valid.

    Raises:
        ScenarioError: with the path of the key, which begins with `path`.
    """
    if not change.link:
        return
    if change.ramp_s:
        raise ScenarioError(
            "a link changes at once; only shares have a ramp", path=f"{path}.ramp_s"
        )
    try:
        problem = change.after.find_problem()
    except msgspec.ValidationError as error:
        refusal, key = split_refusal(error)
        raise ScenarioError(_reword(refusal, key.strip(".")), path=f"{path}.to{key}") from None
    if problem is not None:
        raise ScenarioError(problem.problem, path=f"{path}.to.{problem.key}")


def _reword(problem: str, path: str) -> str:
    """Returns a message of msgspec in the words of a scenario's author."""
    if problem.startswith("Invalid enum value"):
        value = problem.removeprefix("Invalid enum value ")
        choices = _CHOICES[path.rpartition(".")[2]]
        return f"is {value}, must be {' or '.join(map(repr, choices))}"
    if problem.startswith("Object missing required field"):
        return f"{problem.split()[-1].strip('`')} is missing"
    return reword_problem(problem)


def _name_key(resolved: TomlTable, path: str) -> str:
    """Returns the path of a refused key with a name in place of msgspec's `[...]`.

    msgspec writes `sites[...].q0_rad[0]` for an entry of a dictionary. Each entry is tried
    alone, and the first that is refused at that path is named.
    """
    before, placeholder, after = path.partition("[...]")
    if not placeholder:
        return path
    *parent_keys, last_key = before.split(".")
    parent = functools.reduce(operator.getitem, parent_keys, resolved)
    for key, entry in parent[last_key].items():
        parent[last_key] = {key: entry}
        try:
            msgspec.convert(resolved, Scenario)
        except msgspec.ValidationError as error:
            if str(error).endswith(f"`$.{path}`"):
                return f"{before}.{key}{after}"
    return before
