"""Validation: resolved tables become types, and what does not fit becomes an error with the
key's path.

Invariant: what a law needs and a scenario does not give (knowledge of the arm, a number of
sites) is refused before anything runs, with the reason.
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
"""A singular value below this share of the largest is of a direction without motion."""


def refuse_external_arms(scenario: Scenario, given: Collection[str] = ()) -> None:
    """Refuses arms outside of the program, but for those of sites whose motion is given.

    Raises:
        ScenarioError: an arm is external.
    """
    for name in scenario.external:
        if name not in given:
            raise ScenarioError(
                "is external: that arm is outside of the program, and such a scenario runs live only; "
                "plant = 'simulated' runs it in virtual time"
                if name in scenario.outside
                else "is a plant of one's own, which moves in `trilat sim` and live, and not here: "
                "plant = 'simulated' takes the arm of the scenario",
                path=f"sites.{name}.plant",
                source=scenario.name,
            )


OUTSIDE_LIMITS = ("tau_rate_limit_nm_s", "qd_des_limit_rad_s", "q_min_rad", "q_max_rad")
"""Limits that an arm outside of the program must have besides the usual ones."""


def check_outside_arms(scenario: Scenario) -> None:
    """Refuses arms outside of the program without limits, or whose sites would not hold and
    stop in order.

    Logs of earlier versions may lack these, so that this is asked before a session, not of
    every scenario.

    Raises:
        ScenarioError: with the path of the first key that is missing.
    """
    for name in scenario.outside:
        site = scenario.sites[name]
        for key in OUTSIDE_LIMITS:
            if getattr(site.limits, key) is None:
                raise ScenarioError(
                    "is missing: an arm outside of the program needs limits of its position "
                    "(q_min_rad, q_max_rad), its reference (qd_des_limit_rad_s) and the rate of its torque "
                    "(tau_rate_limit_nm_s), besides tau_limit_nm and qd_limit_rad_s",
                    path=f"sites.{name}.limits.{key}",
                    source=scenario.name,
                )
        if site.on_stale.action != "glide":
            raise ScenarioError(
                f"is {site.on_stale.action!r}, and an arm outside of the program needs 'glide': only so does "
                f"its site wait, hold and stop without a jump ({find_page('links.md')})",
                path=f"sites.{name}.on_stale.action",
                source=scenario.name,
            )


def refuse_live_only(scenario: Scenario) -> None:
    """Refuses what a live session alone has: arms outside of the program, and delays of a real
    network.

    Raises:
        ScenarioError: an arm is external, or a link is measured, which in virtual time would be
            one tick.
    """
    refuse_external_arms(scenario)
    if scenario.measured:
        links = (
            f"links.{name}.model" for name, link in scenario.links.items() if link.measured
        )
        raise ScenarioError(
            "is measured: that is the delay of a real network, and such a scenario runs live only; give it a "
            "model, as in link.model=constant and link.delay_ms=50",
            path=next(links, "timeline"),
            source=scenario.name,
        )


def check_law(name: str, site: SiteSpec, sites: int) -> None:
    """Refuses a law that a site, one of so many, cannot carry out, and an arm that contradicts
    its plant.

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
    if (
        not site.arm.known
        and not getattr(law.kind, "needs_theta", False)
        and getattr(law, "gravity", 0.0) * site.arm.g_m_s2 > 0.0
    ):
        raise ScenarioError(
            f"{law.tag} takes gravity from the arm's masses, which are unknown "
            "(arm.known = false): set gravity = 0 if the arm carries itself, arm.g_m_s2 = 0 if it moves in a "
            "horizontal plane, or choose adaptive, which learns it",
            path=f"{path}.control.gravity",
        )


def _check_plant(path: str, site: SiteSpec) -> None:
    """Refuses what contradicts that an arm is in the program, or outside of it."""
    external = site.plant != "simulated"
    if not site.arm.known and not external:
        raise ScenarioError(
            "a simulated arm moves by its masses: leave it true, or set plant = 'external' for an arm "
            "outside of the program",
            path=f"{path}.arm.known",
        )
    if site.arm.dead_man and site.plant != "external":
        raise ScenarioError(
            "is for an arm outside of the program (plant = 'external'): nobody is near a simulated one",
            path=f"{path}.arm.dead_man",
        )
    for group in ("hands", "environment") if external else ():
        if getattr(site, group):
            raise ScenarioError(
                "an arm outside of the program, or of a plant of one's own, is pushed there: leave them out",
                path=f"{path}.{group}",
            )


def _list_words(hint: Any) -> tuple[str, ...]:
    """Returns the words that a type of words, or of words and tables, takes."""
    parts = get_args(hint)
    return sum((_list_words(part) or (part,) * isinstance(part, str) for part in parts), ())


_CHOICES = {
    key: _list_words(kind.__annotations__[key])
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


def build_scenario(resolved: TomlTable) -> Scenario:
    """Turns resolved tables into types; wrong types and ranges become errors with the key's
    path.
    """
    try:
        scenario = msgspec.convert(resolved, Scenario)
    except msgspec.ValidationError as error:
        problem, path = split_refusal(error)
        dotted = _name_key(resolved, path.strip("."))
        drawn = resolved.get("drawn", {}).get(dotted_key(dotted))
        why = f"; {drawn['value']:g} was drawn with seed {resolved['seed']}" if drawn else ""
        raise ScenarioError(_reword(problem, dotted) + why, path=dotted) from None
    _check_joint_space(scenario)
    _check_damping(scenario)
    _check_start_poses(scenario)
    for name in scenario.names:
        _check_limits(scenario, name)
    _check_task_poses(scenario)
    _check_energy_laws(scenario)
    for name, site in scenario.sites.items():
        check_law(name, site, len(scenario.sites))
        check_sends(
            scenario.channel(name), scenario.layout(name).joints, f"sites.{name}.control"
        )
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
    joints = {name: model.counts.joints for name, model in scenario.arms.items()}
    if found := find_expect_problem(scenario.expect, joints):
        raise ScenarioError(found.problem, path=f"expect.{found.key}")
    timeline = (  # links as in `links`, so that 350 and 350.0 are one experiment
        msgspec.structs.replace(one, to=msgspec.to_builtins(one.after)) if one.link else one
        for one in scenario.timeline
    )
    return msgspec.structs.replace(scenario, timeline=tuple(timeline))


def _check_joint_space(scenario: Scenario) -> None:
    """Refuses arms that share different coordinates, and laws that are for no chain."""
    counts = {name: model.counts.joints for name, model in scenario.arms.items()}
    first = scenario.names[0]
    spaces = {name: site.task.space for name, site in scenario.sites.items()}
    for name, joints in counts.items():
        if spaces[name] != spaces[first]:
            raise ScenarioError(
                f"is {spaces[name]!r}, and that of {first} is {spaces[first]!r}: all sites share one space",
                path=f"sites.{name}.task.space",
            )
        if spaces[name] == "joints" and joints != counts[first]:
            raise ScenarioError(
                f"its arm has {count_nouns(joints, 'joint')}, and that of {first} has "
                f"{counts[first]}: joint angles are "
                "compared one by one, so all arms need as many joints, or a task (task.space)",
                path=f"sites.{name}.arm",
            )
        law = scenario.sites[name].control
        if scenario.arms[name].chain is not None and law.planar:
            raise ScenarioError(
                f"{law.tag} has the regressor of the planar arm of two links, and this arm is a chain: "
                "choose adaptive",
                path=f"sites.{name}.control.law",
            )


def _check_links(scenario: Scenario) -> None:
    links = {f"links.{name}": link for name, link in scenario.links.items()}
    views = {
        f"sites.{name}.view": site.view for name, site in scenario.sites.items() if site.view
    }
    for path, link in {**links, **views}.items():
        if found := link.find_problem():
            raise ScenarioError(found.problem, path=f"{path}.{found.key}")
        if path in views and link.measured:
            raise ScenarioError(
                "is 'measured', and no network carries a picture", path=f"{path}.model"
            )


def _check_damping(scenario: Scenario) -> None:
    """Refuses gains that a light joint cannot take.

    A torque -K qd that is held over a period h makes a single joint of inertia M swing from
    tick to tick from K h / M = 1 on (of the second-order scheme, 2 of the digital one); of
    several joints the largest eigenvalue of h K M^-1 counts, here in the start pose.
    """
    for name, model in scenario.arms.items():
        site = scenario.sites[name]
        if model.chain is None or isinstance(site.control, ImportedLaw) or not site.arm.known:
            continue
        gains = site.control.gains(model.theta)
        damping = (
            np.zeros(model.counts.joints)
            + gains.Kp
            + gains.d
            + np.divide(gains.rho, gains.width)
        )
        damping += gains.Kd if site.task.space == "joints" else 0.0
        scaled = np.sqrt(damping)
        spread, modes = np.linalg.eigh(
            scaled * np.linalg.inv(model.inertia(np.array(site.q0_rad))) * scaled[:, None]
        )
        most = 1.0 if scenario.scheme == "second_order" else 2.0
        if spread[-1] / site.rate_hz >= most:
            worst = int(np.argmax(np.abs(modes[:, -1])))
            raise ScenarioError(
                f"damps joint {model.joint_names[worst]} by {damping[worst]:g} N m s/rad in all, "
                f"{spread[-1] / site.rate_hz / most:.3g} times what its inertia can take at "
                f"{site.rate_hz} Hz: lower Kp, Kd or d there, raise rate_hz, or state the drive's "
                "armature_kg_m2",
                path=f"sites.{name}.control",
            )


def _check_received(scenario: Scenario) -> None:
    for site in scenario.names:
        lengths: dict[str, tuple[str, int]] = {}
        for peer in scenario.peers(site):
            for name, _, length, _ in scenario.channel(peer).vectors:
                first, other = lengths.setdefault(name, (peer, length))
                if other != length:
                    raise ScenarioError(
                        f"has {count_nouns(length, 'number')}, and {name} of {first} has "
                        f"{other}; {site} gets both: give "
                        "them one length or two names",
                        path=f"sites.{peer}.control.sends.{name}",
                    )


def _check_energy_laws(scenario: Scenario) -> None:
    """Refuses sites of which only some keep account of energy, and what else such a law has
    against them.
    """
    laws = {name: site.control for name, site in scenario.sites.items()}
    for name, law in laws.items():
        if not law.books_energy:
            continue
        tag = law.tag
        for other, theirs in laws.items():
            if type(theirs) is not type(law):
                problem = f"{name} has {tag}, of which all sites are an end: choose {tag} here, or another there"
                raise ScenarioError(problem, path=f"sites.{other}.control.law")
        rates_hz = {one: site.rate_hz for one, site in scenario.sites.items()}
        if scenario.scheme not in law.kind.schemes:
            problem = f"is {scenario.scheme!r}, and {tag} books the torque of a tick as held: choose 'digital'"
            raise ScenarioError(problem, path="scheme")
        if found := law.find_problem(rates_hz):
            raise ScenarioError(found.problem, path=f"sites.{name}.{found.key}")


def _check_start_poses(scenario: Scenario) -> None:
    for name, model in scenario.arms.items():
        joints = model.chain.joints if model.chain is not None else ()
        for n, (joint, start) in enumerate(
            zip(joints, scenario.sites[name].q0_rad, strict=False)
        ):
            if not joint.lower <= start <= joint.upper:
                unit = "m" if joint.prismatic else "rad"
                path = f"sites.{name}.q0_rad[{n}]"
                drawn = (
                    f", drawn with seed {scenario.seed}"
                    if dotted_key(path) in scenario.drawn
                    else ""
                )
                raise ScenarioError(
                    f"is {start:g} {unit}{drawn}, beyond a stop of joint {model.joint_names[n]}, which moves "
                    f"from {joint.lower:g} to {joint.upper:g} {unit}: start at most "
                    f"{start_margin(joint):g} {unit} beyond, or set stops = false",
                    path=path,
                )


def _check_limits(scenario: Scenario, name: str) -> None:
    """Refuses limits that leave no room, that nothing keeps, or that a start pose breaks."""
    site = scenario.sites[name]
    path = f"sites.{name}.limits"
    limits = scenario.motion_limits(name)
    low = limits.q_min
    high = limits.q_max
    stated = next(
        (key for key in ("q_min_rad", "q_max_rad") if getattr(site.limits, key) is not None), ""
    )
    if stated and site.on_stale.action != "glide":
        raise ScenarioError(
            f"is kept under on_stale.action = 'glide' alone, and here that is {site.on_stale.action!r}",
            path=f"{path}.{stated}",
        )
    if not np.all(np.less(low, high)):
        raise ScenarioError("must be above q_min_rad everywhere", path=f"{path}.q_max_rad")
    start = np.array(site.q0_rad)
    if np.any((start < low) | (start > high)):
        joint = int(np.argmax((start < low) | (start > high)))
        raise ScenarioError(
            f"is {start[joint]:g} rad, beyond q_min_rad or q_max_rad: start at most {START_MARGIN_RAD:g} rad "
            f"({START_MARGIN_M:g} m of a sliding joint) beyond",
            path=f"sites.{name}.q0_rad[{joint}]",
        )


def _check_task_poses(scenario: Scenario) -> None:
    """Refuses an axis along which an end effector cannot move, and a start in a singular pose."""
    for name, model in scenario.arms.items():
        if not model.shares_pose:
            continue
        followed = [axis for axis, on in zip(TASK_AXES, model.axes, strict=False) if on]
        J = model.task_jacobian(scenario.sites[name].q0_rad)[np.array(model.axes) > 0.0]
        joints = model.counts.joints
        path = f"sites.{name}.task.axes"
        for axis, row in zip(followed, J, strict=True):
            if np.abs(row).max() < RANK_TOLERANCE:
                raise ScenarioError(
                    f"has {axis}, along which no joint moves the end effector from its start pose: name the "
                    "axes that the site shall follow, or start elsewhere (q0_rad)",
                    path=path,
                )
        if len(followed) > joints:
            raise ScenarioError(
                f"follows {', '.join(followed)} with {count_nouns(joints, 'joint')}: name "
                f"at most {count_nouns(joints, 'axis')}",
                path=path,
            )
        directions, sizes, _ = np.linalg.svd(J)
        if sizes[-1] < RANK_TOLERANCE * sizes[0]:
            lost = " + ".join(
                f"{part:.2g} {axis}"
                for part, axis in zip(directions[:, -1], followed, strict=True)
                if abs(part) > RANK_TOLERANCE
            )
            raise ScenarioError(
                f"is a singular pose: its end effector cannot move along {lost}; bend a joint, or follow "
                "fewer axes (task.axes)",
                path=f"sites.{name}.q0_rad",
            )


def _check_actors(
    actors: Sequence[operators.Operator | operators.Environment], path: str
) -> None:
    for n, actor in enumerate(actors):
        if found := actor.find_problem():
            raise ScenarioError(found.problem, path=f"{path}[{n}].{found.key}")


def _check_hands(site: SiteSpec, path: str) -> None:
    """Refuses two live hands, one of an arm outside of the program, and one's own out of step
    with ticks.
    """
    live = [
        n for n, hand in enumerate(site.hands) if isinstance(hand, kernel_operators.LiveHand)
    ]
    if live and site.plant != "simulated":
        raise ScenarioError(
            "is a live hand, and the arm is outside of the program, or a plant of one's own: who holds that "
            "arm is measured there, as tau_x of its measurements",
            path=f"{path}[{live[0]}].kind",
        )
    if len(live) > 1:
        raise ScenarioError(
            f"is a second live hand besides {path}[{live[0]}]; an arm has one",
            path=f"{path}[{live[1]}].kind",
        )
    for n, hand in enumerate(site.hands):
        if isinstance(hand, ProgramHand) and site.rate_hz % hand.rate_hz:
            raise ScenarioError(
                f"must divide the site's tick rate, {site.rate_hz} Hz, is {hand.rate_hz}",
                path=f"{path}[{n}].rate_hz",
            )


def check_links_memory(scenario: Scenario, site: str) -> None:
    """Refuses links of a site whose delays would take more than `MAX_LINKS_BYTES`.

    Raises:
        ScenarioError: with the site's path.
    """
    setup = scenario.setup(site)
    wanted = links_bytes(setup, needed_pages(setup))
    if wanted > MAX_LINKS_BYTES:
        raise ScenarioError(
            f"its links would take {wanted / 2**20:.0f} MiB, at most {MAX_LINKS_BYTES >> 20} are given: "
            "shorten the delays, lower rate_hz, or have fewer sites",
            path=f"sites.{site}",
        )


def _check_stale_rules(scenario: Scenario) -> None:
    """Refuses a rule by which a site would always hold: its links or its peers' ticks alone are
    too slow.
    """
    _check_lost(scenario)
    for name, site in scenario.sites.items():
        slowest_hz = min(scenario.sites[one].rate_hz for one in (name, *scenario.peers(name)))
        if site.on_stale.action == "glide" and site.on_stale.silence_ms < 2e3 / slowest_hz:
            raise ScenarioError(
                f"must be at least {2e3 / slowest_hz:g} ms, two periods of {slowest_hz} Hz, "
                f"is {site.on_stale.silence_ms:g}",
                path=f"sites.{name}.on_stale.silence_ms",
            )
        for peer in scenario.peers(name):
            link = scenario.links[f"{peer}->{name}"]
            delay_ms = max(
                link.playout_ms, link.delay_ms if isinstance(link, ConstantDelay) else 0.0
            )
            follows = scenario.dominance[name].get(peer, 0.0) > 0.0
            by_age = site.on_stale.action in ("hold", "brake")
            if by_age and follows and delay_ms >= site.on_stale.age_ms:
                raise ScenarioError(
                    f"must be above the {delay_ms:g} ms of {peer}->{name}, is {site.on_stale.age_ms:g}: "
                    f"the site would never follow {peer}",
                    path=f"sites.{name}.on_stale.age_ms",
                )


def _check_lost(scenario: Scenario) -> None:
    """Refuses sites that would go on without a lost master, where that is not so of any."""
    degrading = [
        name for name, site in scenario.sites.items() if site.on_stale.on_lost == "degrade"
    ]
    for name in degrading:
        if scenario.sites[name].on_stale.action != "glide":
            raise ScenarioError(
                "degrade is of on_stale.action = 'glide' alone: only so does a reference not jump",
                path=f"sites.{name}.on_stale.on_lost",
            )
    masters = [n for n, site in enumerate(scenario.sites.values()) if site.role == "master"]
    alpha = scenario.alpha
    names = scenario.names
    able = [
        name
        for name in degrading
        for n in masters
        if alpha[(own := names.index(name)), n] > 0.0
        and alpha[own].sum() > alpha[own, n]
        and is_irreducible(np.delete(np.delete(alpha, n, 0), n, 1))
    ]
    if degrading and not able:
        raise ScenarioError(
            "no master can be lost: a site goes on without one only if it follows another one, and if those "
            "that are left all reach each other (a chain of shares above 0 from each to each)",
            path=f"sites.{degrading[0]}.on_stale.on_lost",
        )


def check_change(change: Change, path: str) -> None:
    """Refuses a change after which its link is not valid."""
    if not change.link:
        return
    if change.ramp_s:
        raise ScenarioError(
            "a link changes at once; only shares have a ramp", path=f"{path}.ramp_s"
        )
    try:
        found = change.after.find_problem()
    except msgspec.ValidationError as error:
        problem, key = split_refusal(error)
        raise ScenarioError(_reword(problem, key.strip(".")), path=f"{path}.to{key}") from None
    if found:
        raise ScenarioError(found.problem, path=f"{path}.to.{found.key}")


def _reword(problem: str, path: str) -> str:
    if problem.startswith("Invalid enum value"):
        choices = _CHOICES[path.rpartition(".")[2]]
        return f"is {problem.removeprefix('Invalid enum value ')}, must be {' or '.join(map(repr, choices))}"
    if problem.startswith("Object missing required field"):
        return f"{problem.split()[-1].strip('`')} is missing"
    return reword_problem(problem)


def _name_key(resolved: TomlTable, path: str) -> str:
    """Returns `sites[...].q0_rad[0]` with the first key whose entry alone is refused at that
    path.
    """
    before, any_key, after = path.partition("[...]")
    if not any_key:
        return path
    *folders, last = before.split(".")
    parent = functools.reduce(operator.getitem, folders, resolved)
    for key, entry in parent[last].items():
        parent[last] = {key: entry}
        try:
            msgspec.convert(resolved, Scenario)
        except msgspec.ValidationError as error:
            if str(error).endswith(f"`$.{path}`"):
                return f"{before}.{key}{after}"
    return before
