"""Finds a pose in which all coupled arms and their parameter estimates are at rest.

The linear stability analysis describes small motions about such a pose, an equilibrium. There
may be infinitely many equilibria, because any pose on which all arms agree may be one.
`find_equilibrium` therefore computes the equilibrium nearest to a given pose, for example to
the final pose of a run. `predict_equilibrium` computes the equilibrium that the arms reach from
their start poses according to their linear model. A simulated run may supply an initial pose,
but the equilibrium itself is found by solving the equations.

Invariant:
    - The result solves the equations to 1e-10, or a note states that it does not.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np

from ...core import BUCKETS_PER_S, Array, SiteSetup
from ...errors import ScenarioError, UsageError, count_nouns
from ...execution import FusedRun
from ...scenario import Scenario
from ..blas_threads import limit_blas_threads
from ..run_end import EQUILIBRIUM_SPEED_RAD_S
from .linear_loop import LinearLoop
from .numeric_law import NumericLaw
from .operating_point import Equilibrium, OperatingConditions
from .site_dynamics import (
    ArgumentLayout,
    compute_following,
    describe_switching_points,
    has_estimate,
    place_arm,
)
from .textbook_arm import SINGULAR

MAX_PROLONGATION = 8.0
"""Longest run that is simulated to find a pose of rest, as a multiple of the original duration.
"""
_MAX_RUN_TICKS = 4_000_000
"""Length of the longest extended run, in ticks of all sites together."""

MAX_EQUILIBRIUM_RESIDUAL = 1e-10
"""Largest residual of an equilibrium, in rad/s^2."""
_NEWTON_RESIDUAL = 1e-11
"""Residual at which the Gauss-Newton steps end, in rad/s^2: the size of the rounding error."""
_GAUSS_NEWTON_STEPS = 60
"""Largest number of Gauss-Newton steps."""
_MAX_STEP = 0.3
"""Largest change of a state in one Gauss-Newton step, rad or units of the estimate."""
_MAX_HALVINGS = 20
"""Largest number of times that a step is halved."""
_SETTLING_TICKS = 20_000
"""Number of ticks within which the memory of an imported law must become constant."""
_FLAT = 1e-8
"""Largest singular value that counts as zero, relative to the largest one.

A step along its direction leads to other equilibria.
"""


def extend_scenario(scenario: Scenario, duration_s: float) -> Scenario:
    """Returns the same scenario with a longer duration, in which the arms can come to rest.

    Nothing new begins in the additional time. Operators and environments that act at the
    original end continue to act. Chirps and multisines are removed, because they never come to
    rest.

    Args:
        scenario: The scenario.
        duration_s: The longer duration, in s.
    """
    end_s = scenario.duration_s

    def extend_actors(actors: tuple[Any, ...]) -> tuple[Any, ...]:
        """Adapts operators and walls to a longer run in which the arms are to come to rest.

        Operators that never come to rest are removed, and springs that act at the original end
        act until the new end.
        """
        extended = []
        for actor in actors:
            starts_later = getattr(actor, "start_s", 0.0) > end_s
            if starts_later or actor.oscillates:
                continue
            is_present = getattr(actor, "end_s", 0.0) > end_s
            if is_present and hasattr(actor, "stiffness_nm_rad"):
                actor = msgspec.structs.replace(actor, end_s=1e9)
            extended.append(actor)
        return tuple(extended)

    sites = {}
    for name, spec in scenario.sites.items():
        sites[name] = msgspec.structs.replace(
            spec,
            hands=extend_actors(spec.hands),
            environment=extend_actors(spec.environment),
        )
    timeline = tuple(change for change in scenario.timeline if change.at_s <= end_s)
    return msgspec.structs.replace(
        scenario,
        sites=sites,
        timeline=timeline,
        duration_s=duration_s,
    )


def compute_equilibrium_residual(conditions: OperatingConditions, rest: Equilibrium) -> Array:
    """Computes how far a pose is from an equilibrium: the rates of change of the loop's states.

    All rates are zero at an equilibrium. The rates of the angles are zero by definition,
    because all arms are at rest. The other rates are the accelerations and the rates of the
    estimates.

    Args:
        conditions: The sites, gains and delays of the loop.
        rest: The pose, with parameter estimates.

    Returns:
        Rates, one per state, shape (states,).
    """
    arguments = conditions.gather_site_arguments(rest)
    states = []
    for rates in conditions.evaluate_rates(arguments):
        velocities = np.zeros_like(rates.qdd)
        states.append(np.concatenate([velocities, rates.qdd, rates.estimate]))
    return _select_loop_states(conditions, states)


def _select_loop_states(conditions: OperatingConditions, states: Sequence[Array]) -> Array:
    """Joins the states of all sites to one vector, without states that never change.

    The states of a site that are not part of the linear loop are the parameters of a law that
    does not learn.
    """
    masks = conditions.mask_loop_states()
    pairs = zip(states, masks, strict=True)
    return np.concatenate([site_states[mask] for site_states, mask in pairs])


@limit_blas_threads()
def _find_nearest_equilibrium(
    conditions: OperatingConditions, rest: Equilibrium
) -> Equilibrium:
    """Finds the equilibrium, a pose in which all arms rest, that is nearest to a given pose.

    Each Gauss-Newton step is the smallest step that solves the linearised equilibrium
    equations.

    Args:
        conditions: The sites (processes that each run one arm), gains and delays.
        rest: The given pose of all arms, with the estimates of their parameters.

    Returns:
        The equilibrium. Its `residual` says how well it solves the equations.

    Raises:
        ScenarioError: An arm that follows with its end effector is in a singular pose.
    """
    _refuse_singular_poses(conditions, rest)
    if conditions.has_forms:
        # the memory of such a law supplies the holding torque, and a pose does not contain it
        return rest._replace(residual=0.0)

    residual = compute_equilibrium_residual(conditions, rest)
    for _ in range(_GAUSS_NEWTON_STEPS):
        if np.abs(residual).max() <= _NEWTON_RESIDUAL:
            break
        step = _compute_gauss_newton_step(conditions, rest, residual)
        fraction = _limit_step(step)

        residual_norm = np.linalg.norm(residual)
        # a shorter step if the residual does not fall, as when a wall is touched
        for _ in range(_MAX_HALVINGS):
            candidate = _shift_equilibrium(conditions, rest, fraction * step)
            candidate_residual = compute_equilibrium_residual(conditions, candidate)
            if np.linalg.norm(candidate_residual) < residual_norm:
                break
            fraction *= 0.5
        else:
            break  # shorter steps do not reduce the residual either
        rest = candidate
        residual = candidate_residual
    return rest._replace(residual=float(np.abs(residual).max()))


def _limit_step(step: Array) -> float:
    """Returns the factor that shortens an iteration step so that no state changes too much.

    The limit is `_MAX_STEP`. Longer steps would leave the region in which the linearisation is
    useful.
    """
    largest = float(np.abs(step).max())
    return _MAX_STEP / max(largest, _MAX_STEP)


def _compute_gauss_newton_step(
    conditions: OperatingConditions,
    rest: Equilibrium,
    residual: Array,
) -> Array:
    """Returns the smallest step of the loop's states that solves the linearised equations.

    Velocities stay zero. States that cannot change also stay constant, such as an estimate
    without a gain or at a limit of its range. The shape is (states,).
    """
    loop = LinearLoop.of_conditions(conditions, rest, all_estimates=True)
    delayed_matrices = [term.A for term in loop.delayed]
    effects = np.hstack([loop.A, *delayed_matrices])

    is_moved = effects.any(axis=1)
    is_speed = []
    for name in loop.names:
        _, _, state = name.rpartition(".")
        is_speed.append(state.startswith("qd"))
    is_free = is_moved & ~np.array(is_speed)
    free = np.flatnonzero(is_free)

    free_columns = loop.static_matrix[:, free]
    solution = np.linalg.lstsq(free_columns, -residual, rcond=_FLAT)
    step = np.zeros(len(loop.names))
    step[free] = solution[0]
    return step


def _shift_equilibrium(
    conditions: OperatingConditions,
    rest: Equilibrium,
    step: Array,
) -> Equilibrium:
    """Returns the pose and estimates after one iteration step in the search for a pose of rest.

    Velocities in the step are ignored, because all arms rest.
    """
    masks = conditions.mask_loop_states()
    counts = [np.count_nonzero(mask) for mask in masks]
    ends = np.cumsum(counts)
    site_steps = np.split(step, ends[:-1])

    q = np.array(rest.q)
    theta_hat = np.array(rest.theta_hat)
    for index, site in enumerate(conditions.sites):
        layout = ArgumentLayout.of_site(site)
        mask = masks[index]
        states = np.zeros(len(mask))
        states[mask] = site_steps[index]
        q[index, : layout.joints] += states[layout.q]
        theta_hat[index, : layout.parameters] += states[layout.estimate]
    return rest._replace(q=q, theta_hat=theta_hat)


def pad_rows(rows: Sequence[Sequence[float] | Array]) -> Array:
    """Returns vectors of different lengths as the rows of one array, padded with zeros.

    This lets arms with different numbers of joints share an array. For example, (1, 2) and (3,)
    give [[1, 2], [3, 0]].

    Args:
        rows: The vectors.
    """
    longest = max(map(len, rows))
    padded = np.zeros((len(rows), longest))
    for padded_row, row in zip(padded, rows, strict=True):
        padded_row[: len(row)] = row
    return padded


def _refuse_singular_poses(conditions: OperatingConditions, rest: Equilibrium) -> None:
    """Raises an error if an arm that follows with its end effector rests in a singular pose.

    In such a pose, for example a stretched arm, the end effector cannot move in every
    direction.

    Args:
        conditions: The sites and gains.
        rest: The pose of rest.

    Raises:
        ScenarioError: The pose of a site is singular, and the loop has no derivative there.
    """
    arguments = conditions.gather_site_arguments(rest)
    for site, x in zip(conditions.sites, arguments, strict=True):
        layout = ArgumentLayout.of_site(site)
        arm = place_arm(site, x[layout.q])
        following = compute_following(site, arm, x)
        if not following.least > SINGULAR:
            raise ScenarioError(
                "the arm rests in a singular pose, where neither the inverse of the Jacobian "
                "nor the loop has a derivative: let the run end in another pose, or follow "
                "fewer axes",
                path=f"sites.{site.name}.task.axes",
            )


def _predict_from_start(conditions: OperatingConditions, scenario: Scenario) -> Equilibrium:
    """Predicts the equilibrium that the loop reaches from the start poses of a scenario.

    The linear loop is x' = A x + sum_k A_k x(t - T_k), with the state x and the matrices A_k of
    the terms with the delays T_k. It is assumed that all modes decay except those at zero. A
    loop with roots at zero keeps part of its history. With the null vectors W' S = 0 and S V =
    0 of S = A + sum_k A_k, and D = I + sum_k T_k A_k, this part is

        V (W' D V)^-1 W' (x(0) + sum_k A_k int_{-T_k}^0 x)

    Source: Hale and Verduyn Lunel, "Introduction to Functional Differential Equations" (1993),
    chapter 7.

    Args:
        conditions: The sites, gains and delays of the loop.
        scenario: The description of the experiment, with the start poses.
    """
    q = pad_rows([spec.q0_rad for spec in scenario.sites.values()])
    start = Equilibrium(q, _complete_estimates(conditions), "", 0.0)
    # far from the equilibrium, steps of a chain's ten estimates per link diverge; the start is
    # therefore the mean pose with true estimates
    layout = conditions.sites[0].layout
    first_guess = start
    if layout.chain and not layout.task:
        mean_pose = q.mean(axis=0)
        same_poses = np.tile(mean_pose, (len(q), 1))
        first_guess = start._replace(q=same_poses)

    rest = _find_nearest_equilibrium(conditions, first_guess)
    if conditions.has_forms:
        return rest._replace(how="the start poses")

    for _ in range(3):
        deviation = _compute_deviation(conditions, start, rest)
        loop = LinearLoop.of_conditions(conditions, rest, all_estimates=True)
        remaining = _project_on_zero_roots(loop, deviation)
        if remaining is None:
            break
        shifted = _shift_equilibrium(conditions, rest, remaining)
        rest = _find_nearest_equilibrium(conditions, shifted)
    return rest._replace(
        how="predicted from the start poses: the part of the start that the linear loop keeps"
    )


def _compute_deviation(
    conditions: OperatingConditions,
    start: Equilibrium,
    rest: Equilibrium,
) -> Array:
    """Returns how far the start poses of the arms are from a pose of rest, as loop states.

    All velocities are zero. The shape is (states,).
    """
    q_deviation = start.q - rest.q
    estimate_deviation = start.theta_hat - rest.theta_hat
    states = []
    for index, site in enumerate(conditions.sites):
        layout = ArgumentLayout.of_site(site)
        q = q_deviation[index, : layout.joints]
        estimate = estimate_deviation[index, : layout.parameters]
        velocities = np.zeros(layout.joints)
        site_states = np.concatenate([q, velocities, estimate])
        states.append(site_states)
    return _select_loop_states(conditions, states)


def _project_on_zero_roots(loop: LinearLoop, deviation: Array) -> Array | None:
    """Returns the part of an initial deviation that never decays, shape (states,).

    This part belongs to the roots at zero. `_predict_from_start` has the equation. The result
    is `None` if the loop has no roots at zero, or too few vectors for them.
    """
    left, values, right = np.linalg.svd(loop.static_matrix)
    is_zero = values <= _FLAT * values[0]
    zero_roots = int(np.sum(is_zero))
    if not zero_roots:
        return None

    W = left[:, -zero_roots:]
    V = right[-zero_roots:].T
    D = np.eye(len(values))
    for term in loop.delayed:
        D = D + term.delay_s * term.A

    W_D = W.T @ D
    inner = W_D @ V
    if np.linalg.cond(inner) > 1.0 / _FLAT:
        return None

    projected = W_D @ deviation
    coordinates = np.linalg.solve(inner, projected)
    return V @ coordinates


def find_equilibrium(scenario: Scenario, pose: tuple[float, ...] | None = None) -> Equilibrium:
    """Finds a pose in which all arms of a scenario are at rest, as a basis for linear analysis.

    The result is the equilibrium nearest to the final pose of a simulated run, or a pose that
    the user supplies.

    Args:
        scenario: The scenario.
        pose: Pose in which all arms are at rest: one angle per joint in rad, or in task space
            the pose of the end effectors. The estimates of the arm parameters are then assumed
            to be correct. If `None`, a run is simulated, and the equilibrium nearest to its
            final pose is used.

    Returns:
        The equilibrium, with remarks for the user.

    Raises:
        ScenarioError: The scenario cannot be linearised, or has no equilibrium near the final
            pose of its run.
        UsageError: The pose does not have the expected number of finite values.
    """
    conditions = OperatingConditions.derive(scenario)
    if pose is None:
        rest = _find_at_run_end(scenario, conditions)
    else:
        rest = _build_at_pose(pose, conditions)
    return add_limit_notes(conditions, rest)


def add_limit_notes(conditions: OperatingConditions, rest: Equilibrium) -> Equilibrium:
    """Adds remarks about effects that a linear model at the equilibrium misses.

    Examples are torques at their limits and walls that are barely touched.

    Args:
        conditions: The sites, gains and delays of the loop.
        rest: The equilibrium.
    """
    return rest._replace(notes=tuple(_describe_limits(conditions, rest)))


def predict_equilibrium(scenario: Scenario) -> Equilibrium:
    """Predicts where the arms come to rest by linear analysis, without simulating the motion.

    The arms begin in the start poses of the scenario.

    Args:
        scenario: The scenario.

    Raises:
        ScenarioError: The scenario cannot be linearised, or has no equilibrium near the
            prediction.
    """
    conditions = OperatingConditions.derive(scenario)
    return _require_equilibrium(scenario, _predict_from_start(conditions, scenario))


def follow_equilibrium(scenario: Scenario, rest: Equilibrium) -> Equilibrium:
    """Finds the equilibrium of a scenario that is nearest to a known equilibrium.

    The known equilibrium belongs to a similar scenario. This makes it possible to follow an
    equilibrium while a setting, such as a gain, changes in small steps. If the known
    equilibrium is also an equilibrium of this scenario, it is returned, with any missing
    parameter estimates added.

    Args:
        scenario: The scenario.
        rest: Equilibrium of the similar scenario.

    Raises:
        ScenarioError: The scenario cannot be linearised, or has no equilibrium near `rest`.
    """
    conditions = OperatingConditions.derive(scenario)
    start = rest._replace(theta_hat=_complete_estimates(conditions, rest.theta_hat))
    if conditions.has_forms:
        return start
    residual = compute_equilibrium_residual(conditions, start)
    if float(np.abs(residual).max()) <= MAX_EQUILIBRIUM_RESIDUAL:
        return start
    nearest = _find_nearest_equilibrium(conditions, start)
    return _require_equilibrium(scenario, nearest)


def choose_equilibrium(scenario: Scenario) -> Equilibrium:
    """Finds the pose in which the arms of a scenario come to rest, using a suitable method.

    If no control law estimates parameters, and no operator or environment acts, the arms can
    rest in any pose on which they agree. In that case, a linear model of the coupled arms
    predicts which of these poses they reach from their start poses. Otherwise a run is
    simulated, and the equilibrium at its end is found.

    Args:
        scenario: The scenario.

    Raises:
        ScenarioError: The scenario cannot be linearised, or no equilibrium was found.
    """
    sites = OperatingConditions.derive(scenario).sites
    if any(site.gains.is_adaptive or site.actors for site in sites):
        return find_equilibrium(scenario)
    if all(site.gains.is_known for site in sites):
        return predict_equilibrium(scenario)
    # an imported law need not compensate gravity, so the prediction may fail
    with suppress(ScenarioError):
        return predict_equilibrium(scenario)
    return find_equilibrium(scenario)


def _complete_estimates(
    conditions: OperatingConditions, theta_hat: Array | None = None
) -> Array:
    """Returns the parameter estimates of all control laws in one array, padded with zeros.

    Args:
        conditions: The gains, delays and weights of the loop.
        theta_hat: Known estimates, shape (N, P). If `None`, the true parameters are used, or
            for an imported law its initial memory. For laws that do not learn, the assumed
            parameters are used.
    """
    rows = []
    for index, site in enumerate(conditions.sites):
        known = None if theta_hat is None else theta_hat[index]
        if isinstance(site.law_factory, NumericLaw):
            row = site.law_factory.complete_memory(known)
        elif not has_estimate(site):
            row = np.broadcast_to(site.gains.known, site.theta.shape)
        elif known is None:
            row = site.theta
        else:
            row = known[: len(site.theta)]
        rows.append(row)
    return pad_rows(rows)


def _iterate_memories(
    conditions: OperatingConditions,
    rest: Equilibrium,
    ticks: int,
) -> Equilibrium:
    """Returns a pose with the memories of imported laws after some ticks in this pose."""
    theta_hat = rest.theta_hat.copy()
    arguments = conditions.gather_site_arguments(rest)
    for n, (site, x) in enumerate(zip(conditions.sites, arguments, strict=True)):
        if isinstance(site.law_factory, NumericLaw):
            memory = site.law_factory.iterate_memory(x, ticks)
            theta_hat[n, : len(memory)] = memory
    return rest._replace(theta_hat=theta_hat)


def settle_memories(conditions: OperatingConditions, state: Equilibrium) -> Equilibrium:
    """Returns a state in which the memories of imported laws are consistent with the pose.

    The memory of an imported law (a law written by a user) is stored in place of parameter
    estimates. Starting from its initial memory, the law is called repeatedly with the arms in
    the given pose, until the memory is constant. The estimates of other laws remain unchanged.

    Args:
        conditions: The sites, gains and delays of the loop.
        state: Angles and estimates of all sites.
    """
    initial = _complete_estimates(conditions)
    rows = []
    for n, site in enumerate(conditions.sites):
        is_imported = isinstance(site.law_factory, NumericLaw)
        rows.append(initial[n] if is_imported else state.theta_hat[n])
    initialised = state._replace(theta_hat=pad_rows(rows))
    return _iterate_memories(conditions, initialised, _SETTLING_TICKS)


def _build_at_pose(pose: tuple[float, ...], conditions: OperatingConditions) -> Equilibrium:
    """Returns the pose that the user requests as an equilibrium of the arms.

    The control laws are assumed to know the true parameters of their arms.

    Raises:
        ScenarioError: An end effector does not reach the pose, or the pose is singular.
        UsageError: The pose does not consist of as many finite numbers as expected.
    """
    first_site = conditions.sites[0]
    coordinates = ArgumentLayout.of_site(first_site).coordinates
    task = first_site.layout.task
    if len(pose) != coordinates or not np.isfinite(pose).all():
        expected = _describe_pose(coordinates, task=bool(task))
        more = ",..." if coordinates > 2 else ""
        raise UsageError(f"--pose must be {expected}, as in --pose 0.1,0.3{more}, not {pose}")

    target = np.array(pose, dtype=np.float64)
    q = [_reach_pose(site, target) if task else target for site in conditions.sites]
    rest = Equilibrium(
        q=pad_rows(q),
        theta_hat=_complete_estimates(conditions),
        how="the requested pose, with theta_hat = theta",
        residual=0.0,
    )

    _refuse_singular_poses(conditions, rest)
    if conditions.has_forms:
        return rest
    rest = _iterate_memories(conditions, rest, _SETTLING_TICKS)
    residual = compute_equilibrium_residual(conditions, rest)
    return rest._replace(residual=float(np.abs(residual).max()))


def _describe_pose(coordinates: int, *, task: bool) -> str:
    """Returns a phrase for error messages that lists the numbers of a pose."""
    if task:
        rotation = " and a rotation vector in rad" if coordinates > 3 else ""
        return f"a position in m{rotation} of the end effectors"
    if coordinates == 2:
        return f"{count_nouns('two', 'angle')} in rad"
    return f"{count_nouns(str(coordinates), 'angle')} in rad, one per joint"


def _reach_pose(site: SiteSetup, pose: Array) -> Array:
    """Returns joint angles for a desired pose of the end effector, in rad, shape (n,).

    The inverse kinematics are solved by Gauss-Newton steps from the start pose, which find the
    nearest solution.

    Args:
        site: Setup of a site that follows in task space.
        pose: The shared pose, shape (m,).

    Raises:
        ScenarioError: The end effector does not reach the pose along the followed axes.
    """
    layout = ArgumentLayout.of_site(site)
    q = np.array(site.q0, dtype=np.float64)
    for _ in range(_GAUSS_NEWTON_STEPS):
        x = np.zeros(layout.arguments)
        x[layout.q] = q
        x[layout.q_des] = pose
        arm = place_arm(site, q)

        following = compute_following(site, arm, x)
        largest_error = np.abs(following.e).max()
        if largest_error <= _NEWTON_RESIDUAL:
            return q
        assert following.J is not None
        step = np.linalg.lstsq(following.J, -following.e, rcond=_FLAT)[0]
        q = q + step * _limit_step(step)

    raise ScenarioError(
        "the end effector does not reach the pose: an error of "
        f"{largest_error:.2g} m or rad remains",
        path=f"sites.{site.name}.q0_rad",
    )


def find_mean_pose(scenario: Scenario) -> tuple[float, ...]:
    """Returns the mean of the start poses of all arms, shape (m,).

    The pose of an arm is given by its joint angles, or in task space by its end effector.

    Args:
        scenario: The scenario.
    """
    conditions = OperatingConditions.derive(scenario)
    count = len(conditions.sites)
    q = pad_rows([site.q0 for site in conditions.sites])
    equal_alpha = np.full((count, count), 1.0 / count)
    equal_shares = conditions._replace(alpha=equal_alpha)
    start = Equilibrium(q, q, "", 0.0)
    references = equal_shares.compute_references(start)
    return tuple(references[0].tolist())


def _find_at_run_end(scenario: Scenario, conditions: OperatingConditions) -> Equilibrium:
    """Finds the pose of rest nearest to the end of a simulated run.

    The run is extended until the arms rest, up to `MAX_PROLONGATION` times its duration. If the
    run diverges, the pose is predicted from the start poses.
    """
    ticks = sum(map(scenario.ticks, scenario.names))
    affordable_extension = _MAX_RUN_TICKS / ticks
    extension = max(1.0, min(MAX_PROLONGATION, affordable_extension))
    longest_s = scenario.duration_s * extension
    run = FusedRun(extend_scenario(scenario, longest_s))
    until_s = scenario.duration_s

    # double the length of the run until the arms rest
    while True:
        mean_states = run.run_and_sample(until_s)
        last_speeds = [values[-BUCKETS_PER_S:, 1] for values in run.maxima]
        speed_rad_s = max(float(speeds.max()) for speeds in last_speeds)
        is_at_rest = speed_rad_s < EQUILIBRIUM_SPEED_RAD_S
        if run.diverged_s is not None or is_at_rest or 2.0 * until_s > longest_s:
            break
        until_s *= 2.0
    if run.diverged_s is not None:
        rest = _predict_from_start(conditions, scenario)
        how = f"the run diverges at {run.ran_s:.4g} s; {rest.how}"
        return _require_equilibrium(scenario, rest._replace(how=how))
    if is_at_rest:
        q = run.q
        theta_hat = run.theta_hat
        how = (
            f"the run is at rest at {run.ran_s:.4g} s "
            f"(slower than {EQUILIBRIUM_SPEED_RAD_S:g} rad/s)"
        )
    else:
        q, theta_hat = (values.mean(axis=0) for values in mean_states)
        how = (
            f"the run still moves at {run.ran_s:.4g} s ({speed_rad_s:.2g} rad/s): "
            "the equilibrium nearest to the mean of its last quarter"
        )

    user_laws = scenario.user_laws
    if user_laws:
        # the memory of an imported law takes the position of its estimate
        rows = []
        for site, estimate, memory in zip(scenario.names, theta_hat, run.memories, strict=True):
            rows.append(memory if site in user_laws else estimate)
        theta_hat = pad_rows(rows)

    estimates = _complete_estimates(conditions, theta_hat)
    start = Equilibrium(q, estimates, how, 0.0)
    start = _iterate_memories(conditions, start, 1)
    nearest = _find_nearest_equilibrium(conditions, start)
    return _require_equilibrium(scenario, nearest)


def _require_equilibrium(scenario: Scenario, rest: Equilibrium) -> Equilibrium:
    """Checks that the arms rest in a pose, and returns the pose.

    The residual is the largest acceleration that remains in the pose. At an equilibrium it is
    0.

    Raises:
        ScenarioError: The residual is too large, so the pose is not an equilibrium.
    """
    if not rest.residual <= MAX_EQUILIBRIUM_RESIDUAL:
        raise ScenarioError(
            "the loop has no equilibrium near the end of the run "
            f"(residual {rest.residual:.2g} rad/s^2); `trilat linear --pose 0.1,0.3` takes one",
            source=scenario.name,
        )
    return rest


def _describe_limits(conditions: OperatingConditions, rest: Equilibrium) -> Iterator[str]:
    """Yields remarks for the user on effects that the linear loop leaves out.

    The remarks concern a pose that is not an equilibrium, damping near a singular pose, torques
    at their limits, and points at which the model has different derivatives on both sides.
    """
    if rest.residual > MAX_EQUILIBRIUM_RESIDUAL:
        yield (
            "the pose is no equilibrium: accelerations or rates of "
            f"{rest.residual:.2g} remain, and the roots are those of equations frozen at it"
        )

    arguments = conditions.gather_site_arguments(rest)
    for site, x in zip(conditions.sites, arguments, strict=True):
        if site.chain is None or site.chain.task is None:
            continue
        task = site.chain.task
        layout = ArgumentLayout.of_site(site)
        arm = place_arm(site, x[layout.q])
        following = compute_following(site, arm, x)
        least = following.least**0.5
        if least < task.singular_value:
            yield (
                f"{site.name} rests near a singular pose (bound of its least singular value "
                f"{least:.3g}, damped below {task.singular_value:g}): the damping is part of "
                "the loop, and J J+ is not 1"
            )

    all_rates = conditions.evaluate_rates(arguments)
    for site, x, rates in zip(conditions.sites, arguments, all_rates, strict=True):
        torques_nm = np.abs(rates.tau)
        limits_nm = np.broadcast_to(site.tau_limit_nm, rates.tau.shape)
        if (torques_nm >= limits_nm).any():
            worst = int(np.argmax(torques_nm - limits_nm))
            yield (
                f"{site.name} needs {torques_nm[worst]:.4g} N m at rest, and its clamp is "
                f"{limits_nm[worst]:g}: the clamp is left out"
            )
        yield from describe_switching_points(site, x)
