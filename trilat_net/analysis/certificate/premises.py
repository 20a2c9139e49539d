"""What a certificate rests on: the theorem's premises, checked one by one against a log, and
its records.

Invariant: what is missing never counts as stable. Too little of the run or of the periods of V,
and sites that a rerun took over as recorded, leave a run open; a log that was changed passes
nothing. A premise holds, fails, or cannot be decided; each states its evidence. The theorem is
the paper's with the weights and the repaired proof of docs/errata.md: constant delays, constant
dominance factors under which every site reaches every other, one Kd up to a scalar per site,
the adaptive law, and no operator or operators that are passive with respect to r.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...errors import count_nouns
from ...log.accounting import Coverage
from ...log.log_reader import Log
from ...log.running_digest import Integrity
from ...log.session_check import judge_integrity
from ...net.messages import HALTED_MODES
from ...scenario import Scenario
from ..aligned import Bools, find_unlimited_rows
from ..dominance_history import (
    compute_lyapunov_weights,
    find_closed_groups,
    find_kd_scales,
    list_losses,
)
from ..following import TaskFollowing
from ..timeline import find_mode_intervals, recorded_end_s
from ..torque_sources import find_wall_energies, list_sampled_walls
from .energy_balance import (
    ZERO_ENERGY_J,
    EnergyBalance,
    SiteEnergy,
    compute_energy_balance,
    compute_site_energies,
    find_dominance_matrices,
    rise_above_minimum,
)
from .energy_terms import SiteConstants, derive_site_constants

CONSTANT_DELAY_TOLERANCE_S = 1e-7
"""Ages that differ by no more are one: stamps are whole nanoseconds."""
SAMPLING_RISE_SHARE = 1e-4
"""Rises up to this share of the scale are attributed to sampling if the residual is as large.
"""
MIN_FREE_S = 1.0
"""The least free motion at the end of a run of which the theorem speaks, s; and so many times
the largest age of a sample in use:
"""
MIN_FREE_AGES = 5.0
LEAST_ABSENCE_S = 0.1
"""Sites end within that time of each other; a stretch that is shorter is none."""
LEAST_SPEED_M_S = 1e-9
"""What rounding may leave of the speed along an axis along which an end effector cannot move.
"""
MAX_LISTED_NAMES = 4
"""Links or sites that a sentence names."""


NO_COMMON_TIME = "there is no time of which every site has records"
NO_PERIOD = "there is no period of which all records are there"
_OF_ORIENTATIONS = (
    "it follows orientations, whose ed is no derivative of e, so that V has terms of no sign"
)


class Premise(NamedTuple):
    """One premise of the theorem, by its key.

    Attributes:
        holds: True if it holds, False if it fails, None if the log does not decide it.
        text: the evidence.
    """

    name: str
    holds: bool | None
    text: str


def explain_no_functional(scenario: Scenario) -> str:
    """Returns the reasons why sites have no functional; "" if each has one."""
    lacking: dict[str, list[str]] = {}
    for site, spec in scenario.sites.items():
        if not spec.arm.known:
            lacking.setdefault("nobody knows the arm's theta, and V is made of it", []).append(
                site
            )
        elif not spec.control.has_functional:
            lacking.setdefault(
                f"law {spec.control.tag}, for which there is no such V", []
            ).append(site)
        elif spec.task.space == "pose":
            lacking.setdefault(_OF_ORIENTATIONS, []).append(site)
    return "; ".join(f"{', '.join(names)}: {reason}" for reason, names in lacking.items())


class AbsentSpan(NamedTuple):
    """A time in which a site was away from the session, s."""

    site: str
    from_s: float
    to_s: float


class FunctionalFacts(NamedTuple):
    """What is known of V in a run.

    Attributes:
        log: of the run.
        energies, balance: of every site, and of all together.
        groups: the closed groups for which there is at some time no unique beta; () if there is
            one.
        absent: when sites were away.
        unjudged: the times between which records are missing though all sites were there, s.
        tolerance: the size that a rise of V must exceed, J.
    """

    log: Log
    energies: dict[str, SiteEnergy]
    balance: EnergyBalance
    groups: tuple[tuple[str, ...], ...]
    absent: list[AbsentSpan]
    unjudged: list[tuple[float, float]]
    tolerance: float


class RunFacts(NamedTuple):
    """What a log shows of a run, each fact once.

    Attributes:
        log: its log.
        constants: of every site; {} if some law or arm has no V.
        functional: what is known of V; None if nothing is.
        unknown: why that is so; "" of what is known.
    """

    log: Log
    constants: dict[str, SiteConstants]
    functional: FunctionalFacts | None = None
    unknown: str = ""


def gather_facts(log: Log) -> RunFacts:
    """Returns what a log shows of V.

    Raises:
        LogError: a record names a change that is none.
    """
    if lacking := explain_no_functional(log.scenario):
        return RunFacts(log, {}, unknown=lacking)
    constants = {site: derive_site_constants(log.scenario, site) for site in log.sites}
    if not (energies := compute_site_energies(log)):
        return RunFacts(log, constants, unknown=NO_COMMON_TIME)
    balance = compute_energy_balance(energies)
    absent = find_absent_spans(log)
    if not balance.judged.any():
        return RunFacts(log, constants, unknown=NO_PERIOD)
    closed = map(find_closed_groups, find_dominance_matrices(energies))
    groups = next((groups for groups in closed if len(groups) > 1), ())
    named = tuple(tuple(log.sites[n] for n in group) for group in groups)
    there = [
        (from_s, to_s)
        for from_s, to_s in find_unjudged_spans(balance)
        if not any(away.from_s < to_s and from_s < away.to_s for away in absent)
    ]
    sampled = min(float(np.ptp(balance.residual)), SAMPLING_RISE_SHARE * balance.scale)
    tolerance = float(np.ptp(balance.unexplained)) + sampled + ZERO_ENERGY_J
    known = FunctionalFacts(
        log=log,
        energies=energies,
        balance=balance,
        groups=named,
        absent=absent,
        unjudged=there,
        tolerance=tolerance,
    )
    return RunFacts(log, constants, known)


def check_premises(run: RunFacts) -> list[Premise]:
    """Returns the premises of the theorem, and that on sampled walls: what each check finds, in
    order.
    """
    law = (
        "adaptive at every site, of arms whose theta is known" if run.constants else run.unknown
    )
    found: list[Premise | None] = [Premise("law", bool(run.constants), law)]
    if run.constants:
        found += [_check_parameters(run), _check_gains(run)]
    found.append(_check_walls(run.log))
    if run.functional is not None:
        found += [check(run.functional) for check in OF_RUN]
    return [premise for premise in found if premise is not None]


def _check_parameters(run: RunFacts) -> Premise:
    """The truth is in the box, and the estimate is right where nothing is adapted."""
    faults = []
    for site, c in run.constants.items():
        if ((c.theta < c.low) | (c.theta > c.high)).any():
            faults.append(f"{site}: theta is outside of the box that its estimates are held in")
        first = np.clip(
            run.log.scenario.sites[site].control.gains(c.theta).theta_hat0, c.low, c.high
        )
        if (~c.adapts & (first != c.theta)).any():
            faults.append(f"{site}: a parameter is not learnt, and not known either")
        if c.unknown_friction.any():
            faults.append(f"{site}: its law does not compensate all friction of the joints")
    text = "every parameter is learnt or known, and no box shuts it out"
    return Premise("parameters", not faults, _list(faults) or text)


def _check_gains(run: RunFacts) -> Premise:
    constants = run.constants
    Kd = np.array([c.weighing_Kd for c in constants.values()])
    scales = find_kd_scales(Kd)
    if scales is None:
        rows = [
            f"{site} ({', '.join(f'{value:g}' for value in c.Kd)})"
            for site, c in constants.items()
        ]
        text = f"Kd differs in shape between sites, so that no beta exists: {', '.join(rows)}"
        return Premise("Kd", False, text)
    if not Kd.all():  # NaN counts as positive
        return Premise("Kd", False, "some Kd is zero: the theorem asks for positive ones")
    alike = np.ptp(scales) == 0.0
    scalars = f"one Kd but for a scalar: {_per_site(dict(zip(constants, scales, strict=True)))}"
    return Premise("Kd", True, "one Kd for all sites" if alike else scalars)


def _check_walls(log: Log) -> Premise | None:
    """No sampled wall gives energy; None if no wall is sampled."""
    if not any(map(list_sampled_walls, log.scenario.sites.values())):
        return None
    walls = find_wall_energies(log)
    if not walls:
        return Premise("walls", True, "no sampled wall was touched")
    giving = [wall for wall in walls if wall.arm_damping_n_s_m <= wall.required_damping_n_s_m]
    texts = [
        f"{wall.site}: K h / 2 + B is {wall.required_damping_n_s_m:.3g} N s/m, the arm's own damping "
        f"{wall.arm_damping_n_s_m:.3g}; gave {wall.generated_j:.3g} J with respect to qd"
        for wall in giving or walls
    ]
    kind = (
        "a sampled wall gives energy in contact" if giving else "every sampled wall is passive"
    )
    return Premise("walls", not giving, f"{kind}: {'; '.join(texts)}")


def _check_dominance(run: FunctionalFacts) -> Premise:
    names = run.log.scenario.names
    energies = run.energies
    changing = [
        site for site, energy in energies.items() if not energy.motion.dominance.constant
    ]
    if changing:
        lost = list_losses(run.log)
        why = f": {_list(lost)}; those that are left follow each other" if lost else ""
        return Premise("shares", False, f"the shares of {_list(changing)} change{why}")
    Kd = np.array([energy.motion.constants.weighing_Kd for energy in energies.values()])
    weights = compute_lyapunov_weights(run.log.scenario.alpha, Kd)
    groups = [tuple(names[n] for n in group) for group in weights.groups]
    if len(groups) > 1:
        return Premise("shares", False, describe_closed_groups(groups))
    outside = [site for site in names if site not in groups[0]]
    if outside:
        why = f"nobody of {', '.join(groups[0])} follows {', '.join(outside)}, whose beta is 0"
        text = f"alpha is reducible, {why}: V tells nothing of it; it follows as in a cascade"
        return Premise("shares", False, text)
    beta = (
        ""
        if weights.scales is None
        else f"; beta: {_per_site(dict(zip(names, weights.beta, strict=True)))}"
    )
    return Premise("shares", True, f"constant, alpha irreducible{beta}")


def describe_closed_groups(groups: Sequence[Sequence[str]]) -> str:
    """Returns a sentence on closed groups of sites, for which beta is not unique."""
    named = " and ".join("{" + ", ".join(group) + "}" for group in groups)
    return f"{named} follow nobody outside: beta is not unique, certify each group by itself"


def _check_delays(run: FunctionalFacts) -> Premise:
    varying = []
    constant = set()
    for site, energy in run.energies.items():
        records = energy.motion.records
        for peer, view in energy.followed.items():
            used = np.isfinite(view.stamp_s) & records.known
            if not used.any():
                continue
            age_s = (records.t_s - view.stamp_s)[used]
            first_s = view.stamp_s[used][0]
            late = records.first == 0 and first_s > records.h_s + CONSTANT_DELAY_TOLERANCE_S
            if np.ptp(age_s) > CONSTANT_DELAY_TOLERANCE_S or late:
                varying.append(
                    f"{peer}->{site} ({1e3 * age_s.min():.4g} to {1e3 * age_s.max():.4g} ms)"
                )
            else:
                constant.add(f"{1e3 * age_s[0]:.4g} ms")
    if varying:
        return Premise(
            "delays", False, f"the age of the sample in use varies: {_list(varying)}"
        )
    text = f"constant on every link: {', '.join(sorted(constant))}"
    return (
        Premise("delays", True, text)
        if constant
        else Premise("delays", None, "no sample came into use")
    )


def _check_following(run: FunctionalFacts) -> Premise:
    log = run.log
    found = {site: find_mode_intervals(log[site]) for site in log.sites}
    away = [f"{site} {s[0].from_s:.4g} to {s[-1].to_s:.4g} s" for site, s in found.items() if s]
    stops = any(one.mode in HALTED_MODES for intervals in found.values() for one in intervals)
    for site in log.sites:
        held = ~find_unlimited_rows(log.scenario.sites[site].limits, log[site].qd_des)
        if held.any():
            away.append(
                f"{site} with a reference as fast as it may be at "
                f"{count_nouns(np.count_nonzero(held), 'tick')}"
            )
    words = "hold, brake, return or stop" if stops else "hold, brake or return"
    text = f"{words}: {_list(away)}" if away else "every site follows its peers all the time"
    return Premise("following", not away, text)


def _check_torque_limits(run: FunctionalFacts) -> Premise:
    """No torque is cut off; of a chain the joints are named at which one is."""
    cut = {site: energy.motion.limited for site, energy in run.energies.items()}
    ticks = [
        f"{site}{_name_joints(run, site, rows)} at {count_nouns(np.count_nonzero(rows.any(axis=1)), 'tick')}"
        for site, rows in cut.items()
        if rows.any()
    ]
    return Premise(
        "torque", not ticks, f"cut off: {_list(ticks)}" if ticks else "never cut off"
    )


def _name_joints(run: FunctionalFacts, site: str, rows: Bools) -> str:
    """Returns the joints of a chain for which some row is True, in brackets; "" of the planar
    arm.
    """
    model = run.log.scenario.arms[site]
    names = [model.joint_names[n] for n in np.flatnonzero(rows.any(axis=0))]
    return "" if model.chain is None else f" ({_list(names)})"


def _check_stops(run: FunctionalFacts) -> Premise | None:
    """No stop is touched: they are passive with respect to qd, and not to r; None if no joint
    has any.
    """
    chains = [
        model.chain for model in run.log.scenario.arms.values() if model.chain is not None
    ]
    if not any(joint.stop_stiffness for chain in chains for joint in chain.joints):
        return None
    touched = []
    for site, energy in run.energies.items():
        records = energy.motion.records
        pushed = energy.motion.constants.arm.stop_torque(records.q, records.qd) != 0.0
        if pushed.any():
            first_s = records.t_s[int(np.argmax(pushed.any(axis=1)))]
            touched.append(f"{site}{_name_joints(run, site, pushed)} from {first_s:.4g} s on")
    text = (
        f"the arm runs into stops of its joints: {_list(touched)}"
        if touched
        else "no stop is touched"
    )
    return Premise("stops", not touched, text)


def _check_axes(run: FunctionalFacts) -> Premise | None:
    """Nobody follows a site along an axis along which it moves and follows nobody; None in
    joint space.
    """
    motions = {
        site: energy.motion
        for site, energy in run.energies.items()
        if energy.motion.constants.axes
    }
    faults = []
    for site, motion in motions.items():
        free = np.array(motion.constants.axes) == 0.0
        free &= np.abs(motion.records.xd).max(axis=0) > LEAST_SPEED_M_S
        for follower, other in motions.items():
            followed = site in run.energies[follower].followed
            if followed and (free & (np.array(other.constants.axes) > 0.0)).any():
                faults.append(
                    f"{follower} follows {site} along an axis that {site} does not follow"
                )
    text = "every site follows along each axis along which it moves and is followed"
    return Premise("axes", not faults, _list(faults) or text) if motions else None


def _check_singular_poses(run: FunctionalFacts) -> Premise | None:
    """No pose is damped: then J J+ = I; None in joint space."""
    following = {site: energy.motion.following for site, energy in run.energies.items()}
    found = {site: one for site, one in following.items() if isinstance(one, TaskFollowing)}
    near = [
        f"{site} from {run.energies[site].motion.records.t_s[int(np.argmax(one.damping > 0.0))]:.4g} s on"
        for site, one in found.items()
        if one.damping.any()
    ]
    bounds = _per_site({site: one.least.min() for site, one in found.items()})
    text = f"none is near; least singular value at least: {bounds}"
    if near:
        text = f"a pose is so nearly singular that it is damped: {_list(near)}"
    return Premise("singular poses", not near, text) if found else None


def _check_operators(run: FunctionalFacts) -> Premise:
    """Passive with respect to r: they give no more than they took before, up to a constant."""
    energies = run.energies
    balance = run.balance
    pushed_s = {
        site: energy.motion.records.t_s[energy.motion.records.tau_x.any(axis=1)]
        for site, energy in energies.items()
    }
    sites = [site for site, t_s in pushed_s.items() if len(t_s)]
    outside = run.log.scenario.external
    if outside and not sites:
        return Premise("hands", None, f"no record says who pushes the arm of {_list(outside)}")
    if not sites:
        return Premise("hands", True, "nobody pushes")
    weightless = [
        s for n, s in enumerate(energies) if s in sites and not balance.beta[:, n].any()
    ]
    if weightless:
        return Premise(
            "hands",
            False,
            f"{_list(weightless)}, of beta 0, is pushed: V tells nothing of that",
        )
    gave = float(rise_above_minimum(balance.external_work).max())
    who = " and ".join(balance.external)
    if gave <= 1e-9 * balance.scale + ZERO_ENERGY_J:
        return Premise("hands", True, f"the {who} only took: passive with respect to r")
    let_go_s = max(pushed_s[site][-1] for site in sites)
    r = (
        "qd - v"
        if any(energy.motion.constants.axes for energy in energies.values())
        else "qd + Lambda e"
    )
    text = f"the {who} gave up to {gave:.3g} J with respect to r = {r}"
    ages_s = [energy.largest_age_s for energy in energies.values()]
    free_s = float(balance.t_s[-1] - let_go_s)
    least_s = max(MIN_FREE_S, MIN_FREE_AGES * max(ages_s))
    if free_s >= least_s:
        return Premise("hands", True, f"{text}; nobody pushes after {let_go_s:.3f} s")
    if free_s > 1e-9:
        short = f"{free_s:.3g} s of free motion at the end are less than {least_s:.3g} s"
        return Premise("hands", False, f"{text}, and push until {let_go_s:.3f} s: {short}")
    return Premise(
        "hands", False, f"{text}, and push to the end: not passive with respect to r"
    )


def _check_records(run: FunctionalFacts) -> Premise:
    if not run.unjudged:
        where = "" if run.balance.judged.all() else " while all sites were there"
        return Premise("records", True, f"every period of every site rests on records{where}")
    lost = [f"{a:.4g} to {b:.4g} s" for a, b in run.unjudged]
    return Premise("records", None, f"not judged: {_list(lost)}: records are missing there")


def find_absent_spans(log: Log) -> list[AbsentSpan]:
    """Returns when sites were away from the session, in order."""
    end_s = recorded_end_s(log)
    found = []
    for site in log.sites:
        part = log[site]
        spans = [
            (a / part.rate_hz, (b + 1) / part.rate_hz) for a, b in log.absences.get(site, ())
        ]
        left_s = (part.last_tick + 1) / part.rate_hz
        kinds = {event.kind for event in log.events if event.about == site}
        if left_s < end_s - LEAST_ABSENCE_S and kinds & {"left", "lost"}:
            spans.append((left_s, end_s))
        found += [AbsentSpan(site, *span) for span in spans]
    return sorted(found, key=lambda one: one[1:])


def _check_presence(run: FunctionalFacts) -> Premise | None:
    """All sites are there all the time; None if they are. Else what the stretches are by
    themselves.
    """
    if not run.absent:
        return None
    after_s = max(energy.begin_s for energy in run.energies.values())
    edges = [
        (after_s, after_s),
        *((a, b) for _, a, b in run.absent),
        (recorded_end_s(run.log),) * 2,
    ]
    stretches = []
    for from_s, to_s in edges:
        if from_s - after_s > LEAST_ABSENCE_S:
            stretches.append(_describe_stretch(run.energies, after_s, from_s))
        after_s = max(after_s, to_s)
    who = _list([f"{site} {from_s:.4g} to {to_s:.4g} s" for site, from_s, to_s in run.absent])
    text = (
        f"away: {who}, of which the theorem says nothing; by themselves: {'; '.join(stretches)}"
    )
    return Premise("presence", False, text)


OF_RUN = (
    _check_dominance,
    _check_delays,
    _check_following,
    _check_torque_limits,
    _check_stops,
    _check_axes,
    _check_singular_poses,
    _check_operators,
    _check_records,
    _check_presence,
)
"""The premises that a run decides of which V is known."""


def _describe_stretch(energies: Mapping[str, SiteEnergy], from_s: float, to_s: float) -> str:
    """Returns from when on all sites follow in a stretch of time, and if the delays are
    constant then.
    """
    follow_s = from_s
    varying = []
    for energy in energies.values():
        records = energy.motion.records
        apart = (
            records.known & ~records.follows & (records.t_s >= from_s) & (records.t_s < to_s)
        )
        if apart.any():
            follow_s = max(
                follow_s, float(records.t_s[np.flatnonzero(apart)[-1]]) + records.h_s
            )
    stretch = f"{from_s:.4g} to {to_s:.4g} s"
    if to_s - follow_s < LEAST_ABSENCE_S:
        return f"{stretch} not all follow"
    for site, energy in energies.items():
        records = energy.motion.records
        inside = records.known & (records.t_s >= follow_s) & (records.t_s < to_s)
        for peer, view in energy.followed.items():
            age_s = (records.t_s - view.stamp_s)[inside & np.isfinite(view.stamp_s)]
            if len(age_s) and np.ptp(age_s) > CONSTANT_DELAY_TOLERANCE_S:
                varying.append(f"{peer}->{site}")
    delays = f"ages vary ({_list(varying)})" if varying else "delays are constant"
    return f"{stretch} all follow from {follow_s:.4g} s on, {delays}"


def find_unjudged_spans(balance: EnergyBalance) -> list[tuple[float, float]]:
    """Returns the times between which records are missing, s."""
    edges = np.flatnonzero(
        np.diff(np.concatenate([[True], balance.judged, [True]]).astype(np.int8))
    )
    times = balance.t_s[edges]
    return list(zip(times[::2].tolist(), times[1::2].tolist(), strict=True))


def _list(words: Sequence[str]) -> str:
    more = f" and {len(words) - MAX_LISTED_NAMES} more" if len(words) > MAX_LISTED_NAMES else ""
    return ", ".join(words[:MAX_LISTED_NAMES]) + more


def _per_site(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items())


class Evidence(NamedTuple):
    """The records that a certificate rests on.

    Attributes:
        coverage: ticks of every site that have a record, and those of the run.
        functional_share: share of the periods of V that rest on records, while no site was
            away; None without V.
        min_coverage: the least share of either that passes.
        integrity: whether the log is as it was made.
        unmet: sites of an open-loop rerun that met samples which are not in the file.
    """

    coverage: Coverage
    functional_share: float | None
    min_coverage: float
    integrity: Integrity
    unmet: tuple[str, ...] = ()

    @property
    def reasons(self) -> list[str]:
        """What leaves the run open, in words."""
        found = (
            []
            if self.integrity.passed
            else [f"the log is not as it was made: {self.integrity.text}"]
        )
        if self.coverage.share < self.min_coverage:
            found.append(f"records are missing: {self.coverage.describe(self.min_coverage)}")
        if self.functional_share is not None and self.functional_share < self.min_coverage:
            found.append(
                f"V is judged over {100.0 * self.functional_share:.4g} % of its periods"
            )
        if self.unmet:
            found.append(f"{' and '.join(self.unmet)}, as recorded, did not react to this run")
        return found

    @property
    def text(self) -> str:
        """The evidence in one sentence."""
        return f"{self.coverage.describe(self.min_coverage)}; {self.integrity.text}"

    def to_json(self) -> dict[str, Any]:
        """Returns the evidence, ready for JSON."""
        return {
            "coverage": self.coverage.share,
            "functional_coverage": self.functional_share,
            "min_coverage": self.min_coverage,
            "judged": self.coverage.to_json(),
            "integrity": self.integrity.state.name.lower(),
            "open_loop_sites": list(self.unmet),
        }


def collect_evidence(run: RunFacts, min_coverage: float) -> Evidence:
    """Returns what a certificate of a log rests on: of V the periods in which no site was away."""
    log = run.log
    known = run.functional
    share = None
    if known is not None and not known.groups:
        t_s = known.balance.t_s
        judged = known.balance.judged
        asked = np.ones(len(judged), dtype=np.bool_)
        for from_s, to_s in set(find_unjudged_spans(known.balance)) - set(known.unjudged):
            asked &= (t_s[:-1] < from_s) | (t_s[:-1] >= to_s)
        share = float(judged[asked].mean()) if asked.any() else 0.0
    unmet = tuple(site for site in log.sites if site not in log.executed_sites)
    there = {site: len(np.unique(log[site].tick)) for site in log.sites}
    coverage = Coverage(there, {site: log.expected_ticks(site) for site in log.sites})
    return Evidence(
        coverage=coverage,
        functional_share=share,
        min_coverage=min_coverage,
        integrity=judge_integrity(log),
        unmet=unmet,
    )
