"""Equilibria of the loop: at the end of a run, nearest to a pose, or predicted by the linear
loop.

Invariant: the result solves the equations to 1e-10, or a note says that it does not. Equilibria
are not isolated (any pose that the sites agree on may be one), so each is the nearest to a
stated pose. The simulation supplies starting values only.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress

import msgspec
import numpy as np

from ..analysis.run_end import EQUILIBRIUM_SPEED_RAD_S
from ..core.site_setup import Law, SiteSetup
from ..core.ticks import BUCKETS_PER_S
from ..core.vectors import Array
from ..errors import ScenarioError, UsageError, count_nouns
from ..execution.fused import FusedRun
from ..scenario import Scenario
from ..scenario.imported_code import ImportedLaw
from ..scenario.operators.kernel_operators import Chirp, Multisine
from . import linear_loop
from .characteristic_roots import limit_blas_threads
from .numeric_law import NumericLaw
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .site_dynamics import (
    describe_switching_points,
    follow_peers,
    has_estimate,
    lay_out_arguments,
    place_arm,
)
from .textbook_arm import SINGULAR

MAX_PROLONGATION = 8.0
"""A run that is not at rest goes on for up to this multiple of its duration."""
_MAX_RUN_TICKS = 4_000_000
"""Limit of a prolonged run, in ticks of all sites together."""

MAX_EQUILIBRIUM_RESIDUAL = 1e-10
"""The largest residual of an equilibrium."""
_NEWTON_RESIDUAL = 1e-11
"""A residual below this is rounding, rad/s^2."""
_GAUSS_NEWTON_STEPS = 60
_MAX_STEP = 0.3
_MAX_HALVINGS = 20
_SETTLING_TICKS = 20_000
_FLAT = 1e-8
"""A singular value this small, relative to the largest, belongs to a direction of further
equilibria.
"""


def extend_scenario(scenario: Scenario, duration_s: float) -> Scenario:
    """Returns the experiment prolonged: forces present at its end stay, but for those that
    swing.

    Nothing new begins.
    """
    end_s = scenario.duration_s

    def prolong(actors: tuple[msgspec.Struct, ...]) -> tuple[msgspec.Struct, ...]:
        return tuple(
            msgspec.structs.replace(actor, end_s=1e9)
            if getattr(actor, "end_s", 0.0) > end_s and hasattr(actor, "stiffness_nm_rad")
            else actor
            for actor in actors
            if getattr(actor, "start_s", 0.0) <= end_s
            and not isinstance(actor, Chirp | Multisine)
        )

    sites = {
        name: msgspec.structs.replace(
            spec, hands=prolong(spec.hands), environment=prolong(spec.environment)
        )
        for name, spec in scenario.sites.items()
    }
    timeline = tuple(change for change in scenario.timeline if change.at_s <= end_s)
    return msgspec.structs.replace(
        scenario, sites=sites, timeline=timeline, duration_s=duration_s
    )


def compute_equilibrium_residual(conditions: OperatingConditions, rest: Equilibrium) -> Array:
    """Returns the accelerations and rates of estimates at a pose, in the order of the loop's
    states.

    The derivatives of the angles are zero.
    """
    x = linear_loop.gather_site_arguments(conditions, rest)
    states = [
        np.concatenate([np.zeros_like(one.qdd), one.qdd, one.estimate])
        for one in conditions.evaluate_rates(x)
    ]
    return _select_loop_states(conditions, states)


def _select_loop_states(conditions: OperatingConditions, states: Sequence[Array]) -> Array:
    masks = linear_loop.mask_loop_states(conditions)
    return np.concatenate([own[mask] for own, mask in zip(states, masks, strict=True)])


@limit_blas_threads()
def find_nearest_equilibrium(conditions: OperatingConditions, rest: Equilibrium) -> Equilibrium:
    """Returns the equilibrium nearest to a pose: Gauss-Newton steps of least norm from there.

    Raises:
        ScenarioError: a site in task space is in a singular pose.
    """
    _refuse_singular_poses(conditions, rest)
    if conditions.has_forms:  # what such a law remembers is not in a pose
        return rest._replace(residual=0.0)
    residual = compute_equilibrium_residual(conditions, rest)
    for _ in range(_GAUSS_NEWTON_STEPS):
        if np.abs(residual).max() <= _NEWTON_RESIDUAL:
            break
        loop = linear_loop.linearise_loop(conditions, rest, all_estimates=True)
        effects = np.hstack([loop.A, *(term.A for term in loop.delayed)])
        # velocities are zero, and what nothing moves (an estimate without a gain, at an end of its box) stays
        speeds = [name.rpartition(".")[2].startswith("qd") for name in loop.names]
        free = np.flatnonzero(effects.any(axis=1) & ~np.array(speeds))
        step = np.zeros(len(loop.names))
        step[free] = np.linalg.lstsq(loop.static_matrix[:, free], -residual, rcond=_FLAT)[0]
        share = _MAX_STEP / max(float(np.abs(step).max()), _MAX_STEP)
        for _ in range(_MAX_HALVINGS):  # touching a wall changes the next step
            tried = _shift_equilibrium(conditions, rest, share * step)
            after = compute_equilibrium_residual(conditions, tried)
            if np.linalg.norm(after) < np.linalg.norm(residual):
                break
            share *= 0.5
        else:
            break
        rest = tried
        residual = after
    return rest._replace(residual=float(np.abs(residual).max()))


def _shift_equilibrium(
    conditions: OperatingConditions, rest: Equilibrium, step: Array
) -> Equilibrium:
    """Returns an equilibrium shifted by a deviation of the loop's states; velocities do not
    count.
    """
    masks = linear_loop.mask_loop_states(conditions)
    parts = np.split(step, np.cumsum([np.count_nonzero(mask) for mask in masks])[:-1])
    q = np.array(rest.q)
    theta_hat = np.array(rest.theta_hat)
    for n, (site, mask, part) in enumerate(zip(conditions.sites, masks, parts, strict=True)):
        at = lay_out_arguments(site)
        states = np.zeros(len(mask))
        states[mask] = part
        q[n, : at.joints] += states[at.q]
        theta_hat[n, : at.parameters] += states[at.estimate]
    return rest._replace(q=q, theta_hat=theta_hat)


def pad_rows(rows: Sequence[Sequence[float] | Array]) -> Array:
    """Returns vectors of several lengths as the rows of one array, the shorter ones followed by
    zeros.
    """
    padded = np.zeros((len(rows), max(map(len, rows))))
    for own, row in zip(padded, rows, strict=True):
        own[: len(row)] = row
    return padded


def _refuse_singular_poses(conditions: OperatingConditions, rest: Equilibrium) -> None:
    for site, x in zip(
        conditions.sites, linear_loop.gather_site_arguments(conditions, rest), strict=True
    ):
        arm = place_arm(site, x[lay_out_arguments(site).q])
        if not follow_peers(site, arm, x).least > SINGULAR:
            raise ScenarioError(
                "rests in a singular pose, where the inverse of its Jacobian, and so the loop, has no "
                "derivative: end it elsewhere, or follow fewer axes",
                path=f"sites.{site.name}.task.axes",
            )


def predict_from_start(conditions: OperatingConditions, scenario: Scenario) -> Equilibrium:
    """Returns the equilibrium that the linear loop reaches from the start poses if its other
    modes decay.

    A loop with roots at zero keeps part of its history: with null vectors W' S = 0 and S V = 0
    of S = A + sum_k A_k, and D = I + sum_k T_k A_k, it is V (W' D V)^-1 W' (x(0) + sum_k A_k
    int_{-T_k}^0 x). Hale and Verduyn Lunel, "Introduction to Functional Differential Equations"
    (1993), chapter 7.
    """
    q = pad_rows([spec.q0_rad for spec in scenario.sites.values()])
    start = Equilibrium(q, _complete_estimates(conditions), "", 0.0)
    # ten estimates a link lead steps from afar astray; about a shared pose they are true
    layout = conditions.sites[0].layout
    alike = layout.chain and not layout.task
    about = start._replace(q=np.tile(q.mean(axis=0), (len(q), 1))) if alike else start
    rest = find_nearest_equilibrium(conditions, about)
    if conditions.has_forms:
        return rest._replace(how="the start poses")
    for _ in range(3):
        moved = []
        for site, dq, d_theta in zip(
            conditions.sites, start.q - rest.q, start.theta_hat - rest.theta_hat, strict=True
        ):
            at = lay_out_arguments(site)
            moved.append(
                np.concatenate([dq[: at.joints], np.zeros(at.joints), d_theta[: at.parameters]])
            )
        deviation = _select_loop_states(conditions, moved)
        loop = linear_loop.linearise_loop(conditions, rest, all_estimates=True)
        kept = _project_on_zero_roots(loop, deviation)
        if kept is None:
            break
        rest = find_nearest_equilibrium(conditions, _shift_equilibrium(conditions, rest, kept))
    return rest._replace(
        how="predicted from the start poses: what the linear loop keeps of its start"
    )


def _project_on_zero_roots(loop: linear_loop.LinearLoop, deviation: Array) -> Array | None:
    """Returns the part of a constant deviation that stays; None if roots at zero have too few
    vectors.
    """
    left, values, right = np.linalg.svd(loop.static_matrix)
    count = int(np.sum(values <= _FLAT * values[0]))
    if not count:
        return None
    W = left[:, -count:]
    V = right[-count:].T
    D = sum((term.delay_s * term.A for term in loop.delayed), np.eye(len(values)))
    inner = W.T @ D @ V
    if np.linalg.cond(inner) > 1.0 / _FLAT:
        return None
    return V @ np.linalg.solve(inner, W.T @ D @ deviation)


def find_equilibrium(scenario: Scenario, pose: tuple[float, ...] | None = None) -> Equilibrium:
    """Returns the equilibrium of a scenario: at the end of a run, or at a pose, rad, with true
    estimates.

    Raises:
        ScenarioError: the scenario has no linear loop, or no equilibrium near the end of its
            run.
        UsageError: the pose is not a finite angle for every joint.
    """
    conditions = derive_operating_conditions(scenario)
    rest = (
        _find_at_run_end(scenario, conditions) if pose is None else _take_pose(pose, conditions)
    )
    return rest._replace(notes=tuple(_describe_limits(conditions, rest)))


def predict_equilibrium(scenario: Scenario) -> Equilibrium:
    """Returns the equilibrium that the linear loop predicts from the start poses, without a
    run.

    Raises:
        ScenarioError: the scenario has no linear loop, or no equilibrium there.
    """
    conditions = derive_operating_conditions(scenario)
    return _require_equilibrium(scenario, predict_from_start(conditions, scenario))


def follow_equilibrium(scenario: Scenario, rest: Equilibrium) -> Equilibrium:
    """Returns the equilibrium of a scenario nearest to that of another one; the same if it
    still is one.

    Raises:
        ScenarioError: the scenario has no linear loop, or no equilibrium there.
    """
    conditions = derive_operating_conditions(scenario)
    start = rest._replace(theta_hat=_complete_estimates(conditions, rest.theta_hat))
    if (
        conditions.has_forms
        or float(np.abs(compute_equilibrium_residual(conditions, start)).max())
        <= MAX_EQUILIBRIUM_RESIDUAL
    ):
        return start
    return _require_equilibrium(scenario, find_nearest_equilibrium(conditions, start))


def choose_equilibrium(scenario: Scenario) -> Equilibrium:
    """Returns the equilibrium of a scenario: predicted if any shared pose is one, else the end
    of a run.

    Any shared pose is an equilibrium if no site has estimates and no operator or environment
    acts.

    Raises:
        ScenarioError: the scenario has no linear loop, or no equilibrium there.
    """
    sites = derive_operating_conditions(scenario).sites
    if any(site.gains.law is Law.ADAPTIVE or site.actors for site in sites):
        return find_equilibrium(scenario)
    if all(site.gains.law is Law.KNOWN for site in sites):
        return predict_equilibrium(scenario)
    with suppress(ScenarioError):  # a law of one's own need not carry gravity
        return predict_equilibrium(scenario)
    return find_equilibrium(scenario)


def _complete_estimates(
    conditions: OperatingConditions, theta_hat: Array | None = None
) -> Array:
    """Returns estimates, the truth if none are given; of laws that learn nothing, the law's
    parameters.

    Of a law of one's own it is the memory, by default that at the beginning.
    """
    rows = []
    for n, site in enumerate(conditions.sites):
        given = None if theta_hat is None else theta_hat[n]
        if isinstance(site.law_factory, NumericLaw):
            rows.append(site.law_factory.complete_memory(given))
        elif has_estimate(site):
            rows.append(site.theta if given is None else given[: len(site.theta)])
        else:
            rows.append(np.broadcast_to(site.gains.known, site.theta.shape))
    return pad_rows(rows)


def _settle_memories(
    conditions: OperatingConditions, rest: Equilibrium, ticks: int
) -> Equilibrium:
    theta_hat = rest.theta_hat.copy()
    for n, (site, x) in enumerate(
        zip(conditions.sites, linear_loop.gather_site_arguments(conditions, rest), strict=True)
    ):
        if isinstance(site.law_factory, NumericLaw):
            theta_hat[n, : len(site.law_factory.memory)] = site.law_factory.iterate_memory(
                x, ticks
            )
    return rest._replace(theta_hat=theta_hat)


def _take_pose(pose: tuple[float, ...], conditions: OperatingConditions) -> Equilibrium:
    at = lay_out_arguments(conditions.sites[0])
    task = conditions.sites[0].layout.task
    if len(pose) != at.coordinates or not np.isfinite(pose).all():
        count = "two" if at.coordinates == 2 else str(at.coordinates)
        numbers = f"{count_nouns(count, 'angle')} in rad" + (
            ", one per joint" if at.coordinates != 2 else ""
        )
        if task:
            numbers = f"a place in m{' and a rotation vector in rad' * (at.coordinates > 3)} of the end effectors"
        raise UsageError(
            f"--pose is {numbers}, as in --pose 0.1,0.3{',...' * (at.coordinates > 2)}, not {pose}"
        )
    target = np.array(pose, dtype=np.float64)
    q = [reach_pose(site, target) if task else target for site in conditions.sites]
    rest = Equilibrium(
        pad_rows(q),
        _complete_estimates(conditions),
        "the pose that was asked for, with theta_hat = theta",
        0.0,
    )
    _refuse_singular_poses(conditions, rest)
    if conditions.has_forms:
        return rest
    rest = _settle_memories(conditions, rest, _SETTLING_TICKS)
    return rest._replace(
        residual=float(np.abs(compute_equilibrium_residual(conditions, rest)).max())
    )


def reach_pose(site: SiteSetup, pose: Array) -> Array:
    """Returns the angles, nearest to the start pose, at which a site's end effector is at a
    shared pose.

    Raises:
        ScenarioError: it cannot be there along the axes that the site follows.
    """
    at = lay_out_arguments(site)
    q = np.array(site.q0, dtype=np.float64)
    for _ in range(_GAUSS_NEWTON_STEPS):
        x = np.zeros(at.arguments)
        x[at.q] = q
        x[at.q_des] = pose
        following = follow_peers(site, place_arm(site, q), x)
        if np.abs(following.e).max() <= _NEWTON_RESIDUAL:
            return q
        assert following.J is not None
        step = np.linalg.lstsq(following.J, -following.e, rcond=_FLAT)[0]
        q = q + step * (_MAX_STEP / max(float(np.abs(step).max()), _MAX_STEP))
    raise ScenarioError(
        f"its end effector does not reach the pose: {np.abs(following.e).max():.2g} m or rad are left",
        path=f"sites.{site.name}.q0_rad",
    )


def find_mean_pose(scenario: Scenario) -> tuple[float, ...]:
    """Returns the mean of what sites share of their start poses: angles, or their end
    effectors' poses.
    """
    conditions = derive_operating_conditions(scenario)
    count = len(conditions.sites)
    q = pad_rows([site.q0 for site in conditions.sites])
    alike = conditions._replace(alpha=np.full((count, count), 1.0 / count))
    return tuple(linear_loop.compute_references(alike, Equilibrium(q, q, "", 0.0))[0].tolist())


def _find_at_run_end(scenario: Scenario, conditions: OperatingConditions) -> Equilibrium:
    """Runs a scenario until it is at rest, for at most `MAX_PROLONGATION` times its duration."""
    ticks = sum(map(scenario.ticks, scenario.names))
    most_s = scenario.duration_s * max(1.0, min(MAX_PROLONGATION, _MAX_RUN_TICKS / ticks))
    run = FusedRun(extend_scenario(scenario, most_s))
    until_s = scenario.duration_s
    while True:
        states = run.run_and_sample(until_s)
        speed_rad_s = max(float(values[-BUCKETS_PER_S:, 1].max()) for values in run.maxima)
        if (
            run.diverged_s is not None
            or speed_rad_s < EQUILIBRIUM_SPEED_RAD_S
            or 2.0 * until_s > most_s
        ):
            break
        until_s *= 2.0
    if run.diverged_s is not None:
        rest = predict_from_start(conditions, scenario)
        how = f"the run diverges at {run.ran_s:.4g} s; {rest.how}"
        return _require_equilibrium(scenario, rest._replace(how=how))
    if speed_rad_s < EQUILIBRIUM_SPEED_RAD_S:
        q = run.q
        theta_hat = run.theta_hat
        how = f"the run is at rest at {run.ran_s:.4g} s (slower than {EQUILIBRIUM_SPEED_RAD_S:g} rad/s)"
    else:
        q, theta_hat = (values.mean(axis=0) for values in states)
        how = f"the run still moves at {run.ran_s:.4g} s ({speed_rad_s:.2g} rad/s): the equilibrium nearest "
        how += "to the mean of its last quarter"
    laws = scenario.controls
    # of such a law the estimate is its memory
    if any(isinstance(law, ImportedLaw) for law in laws):
        rows = zip(laws, theta_hat, run.memories, strict=True)
        theta_hat = pad_rows(
            [own if isinstance(law, ImportedLaw) else row for law, row, own in rows]
        )
    start = Equilibrium(q, _complete_estimates(conditions, theta_hat), how, 0.0)
    start = _settle_memories(conditions, start, 1)
    return _require_equilibrium(scenario, find_nearest_equilibrium(conditions, start))


def _require_equilibrium(scenario: Scenario, rest: Equilibrium) -> Equilibrium:
    if not rest.residual <= MAX_EQUILIBRIUM_RESIDUAL:
        raise ScenarioError(
            f"the loop has no equilibrium near the end of its run (residual {rest.residual:.2g} rad/s^2); "
            "give a pose, as in --pose 0.1,0.3",
            source=scenario.name,
        )
    return rest


def _describe_limits(conditions: OperatingConditions, rest: Equilibrium) -> Iterator[str]:
    if rest.residual > MAX_EQUILIBRIUM_RESIDUAL:
        yield (
            f"the pose is no equilibrium: accelerations or rates of {rest.residual:.2g} remain, and the "
            "roots are those of equations frozen at it"
        )
    x = linear_loop.gather_site_arguments(conditions, rest)
    for site, own in zip(conditions.sites, x, strict=True):
        least = (
            follow_peers(site, place_arm(site, own[lay_out_arguments(site).q]), own).least
            ** 0.5
        )
        task = None if site.chain is None else site.chain.task
        if task is not None and least < task.singular_value:
            yield (
                f"{site.name} rests near a singular pose (bound of its least singular value {least:.3g}, "
                f"damped below {task.singular_value:g}): the damping is part of the loop, and J J+ is not 1"
            )
    for site, own, rates in zip(conditions.sites, x, conditions.evaluate_rates(x), strict=True):
        torques_nm = np.abs(rates.tau)
        limits_nm = np.broadcast_to(site.tau_limit_nm, rates.tau.shape)
        if (torques_nm >= limits_nm).any():
            worst = int(np.argmax(torques_nm - limits_nm))
            yield (
                f"{site.name} needs {torques_nm[worst]:.4g} N m at rest, and its clamp is "
                f"{limits_nm[worst]:g}: the clamp is left out"
            )
        yield from describe_switching_points(site, own)
