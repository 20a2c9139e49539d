"""Equilibria of the loop: at the end of a run, nearest to a pose, or predicted by the linear loop.

Invariant: the result solves the equations to 1e-10, or a note says that it does not. Equilibria are not
isolated (any pose that the sites agree on may be one), so each is the nearest to a stated pose. The
simulation supplies starting values only.
"""

from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np

from ..analysis.run_end import EQUILIBRIUM_SPEED_RAD_S, find_end_maxima
from ..core.site_setup import Law
from ..core.two_link_arm import JOINTS
from ..core.vectors import Array
from ..errors import ScenarioError, UsageError
from ..execution.fused import FusedRun
from ..scenario import Scenario
from .linear_loop import LinearLoop, gather_site_arguments, linearise_loop
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .site_dynamics import ESTIMATE, QD, describe_switching_points, has_estimate

MAX_PROLONGATION = 8.0
"""A run that is not at rest goes on for up to so many times its duration."""
MAX_RUN_TICKS = 4_000_000
"""Ticks of all sites together; a run goes on no further than that."""
_KEPT = 100
"""States of the last stretch that a mean is made of."""


class EquilibriumRun(NamedTuple):
    """The end of a run.

    Attributes:
        t_s: when it ended, s.
        speed_rad_s: the largest joint speed of its last second, rad/s.
        diverged: whether a site left its limits.
        q: joint angles at the end, shape (N, 2), rad.
        theta_hat: estimates at the end, shape (N, 5).
        mean_q: joint angles on average over the last quarter, shape (N, 2), rad.
        mean_theta_hat: estimates on average over the last quarter, shape (N, 5).
    """

    t_s: float
    speed_rad_s: float
    diverged: bool
    q: Array
    theta_hat: Array
    mean_q: Array
    mean_theta_hat: Array

    @property
    def at_rest(self) -> bool:
        """True where nothing moves any more."""
        return not self.diverged and self.speed_rad_s < EQUILIBRIUM_SPEED_RAD_S


def run_to_equilibrium(scenario: Scenario) -> EquilibriumRun:
    """Runs a scenario until it rests, and for at most `LONGEST` times its duration.

    Args:
        scenario: the experiment.

    Raises:
        ScenarioError: virtual time cannot run it.
    """
    ticks = sum(map(scenario.ticks, scenario.names))
    most_s = scenario.duration_s * max(1.0, min(MAX_PROLONGATION, MAX_RUN_TICKS / ticks))
    run = FusedRun(prolong_scenario(scenario, most_s))
    look_s = scenario.duration_s
    while True:
        q, theta_hat = _last_quarter(run, look_s)
        _, speed_rad_s = find_end_maxima(run.maxima)
        if run.diverged_s is not None or speed_rad_s < EQUILIBRIUM_SPEED_RAD_S or 2.0 * look_s > most_s:
            break
        look_s *= 2.0
    diverged = run.diverged_s is not None
    return EquilibriumRun(run.ran_s, speed_rad_s, diverged, run.q, run.theta_hat, q, theta_hat)


def _last_quarter(run: FusedRun, until_s: float) -> tuple[Array, Array]:
    """Goes on with a run; returns the mean of its angles and estimates over the last quarter of its time."""
    q, theta_hat = [], []
    for t_s in np.linspace(0.75 * until_s, until_s, _KEPT):
        run.advance(float(t_s))
        q.append(run.q)
        theta_hat.append(run.theta_hat)
    return np.mean(q, axis=0), np.mean(theta_hat, axis=0)


NEWTON_RESIDUAL = 1e-11
"""A residual below this is rounding: accelerations in rad/s^2."""
GAUSS_NEWTON_STEPS = 60
_LARGEST_STEP = 0.3
_HALVINGS = 20
_FLAT = 1e-8
"""A direction in which the field changes so little, beside the steepest, is one along which all rests."""


def compute_equilibrium_residual(now: OperatingConditions, rest: Equilibrium) -> Array:
    """Returns what is left at a rest: accelerations and rates of estimates, as the loop's states lie.

    The derivatives of the angles are zero there and have zeros in their places.
    """
    x = gather_site_arguments(now, rest)
    parts = []
    for i, site in enumerate(now.sites):
        found = now.rates(i, x[i])
        parts += [np.zeros(JOINTS), found.qdd]
        if has_estimate(site):
            parts.append(found.estimate)
    return np.concatenate(parts)


def find_nearest_equilibrium(now: OperatingConditions, rest: Equilibrium) -> Equilibrium:
    """Returns the equilibrium next to a pose, by Gauss and Newton with the least change of every step.

    Args:
        now: what holds.
        rest: the pose to begin from.
    """
    left = compute_equilibrium_residual(now, rest)
    for _ in range(GAUSS_NEWTON_STEPS):
        if np.abs(left).max() <= NEWTON_RESIDUAL:
            break
        loop = linearise_loop(now, rest)
        free = _free(loop)
        step = np.zeros(len(loop.names))
        step[free] = np.linalg.lstsq(build_static_matrix(loop)[:, free], -left, rcond=_FLAT)[0]
        share = min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), _LARGEST_STEP))
        tried, after = rest, left
        for _ in range(_HALVINGS):  # a wall met on the way turns the next step
            tried = shift_equilibrium(now, rest, share * step)
            after = compute_equilibrium_residual(now, tried)
            if np.linalg.norm(after) < np.linalg.norm(left):
                break
            share *= 0.5
        else:
            break
        rest, left = tried, after
    return rest._replace(residual=float(np.abs(left).max()))


def _free(loop: LinearLoop) -> list[int]:
    """Returns the states that an equilibrium may be moved along.

    Velocities are zero, and what nothing moves (an estimate without a gain, one held at an end of its box)
    stays where the run has it.
    """
    movers = np.hstack([loop.A, *(delayed.A for delayed in loop.delayed)])
    return [n for n, name in enumerate(loop.names) if ".qd" not in name and np.any(movers[n])]


def build_static_matrix(loop: LinearLoop) -> Array:
    """Returns A + sum_k A_k: what acts on what does not change."""
    total = loop.A.copy()
    for delayed in loop.delayed:
        total += delayed.A
    return total


def shift_equilibrium(now: OperatingConditions, rest: Equilibrium, step: Array) -> Equilibrium:
    """Returns a rest shifted by a deviation of the loop's states, of which velocities do not count."""
    q, theta_hat = rest.q.copy(), rest.theta_hat.copy()
    first = 0
    for i, site in enumerate(now.sites):
        q[i] += step[first : first + JOINTS]
        first += QD.stop
        if has_estimate(site):
            theta_hat[i] += step[first : first + ESTIMATE.stop - ESTIMATE.start]
            first += ESTIMATE.stop - ESTIMATE.start
    return rest._replace(q=q, theta_hat=theta_hat)


def predict_from_start(now: OperatingConditions, start: Equilibrium) -> Equilibrium:
    """Returns where the linear loop would come to rest from the start, did its other modes die away.

    A loop with roots at zero keeps something of its history: with null vectors W' S = 0 and S V = 0 of S = A
    + sum_k A_k, and D = I + sum_k T_k A_k, it is V (W' D V)^-1 W' (x(0) + sum_k A_k int_{-T_k}^0 x). Hale
    and Verduyn Lunel, "Introduction to Functional Differential Equations" (1993), chapter 7.

    Args:
        now: what holds.
        start: where all begin, and have been still.
    """
    rest = find_nearest_equilibrium(now, start)
    for _ in range(3):
        loop = linearise_loop(now, rest)
        kept = _kept(loop, _deviation(now, start, rest))
        if kept is None:
            break
        rest = find_nearest_equilibrium(now, shift_equilibrium(now, rest, kept))
    return rest._replace(how="predicted from the start poses: what the linear loop keeps of its start")


def _deviation(now: OperatingConditions, start: Equilibrium, rest: Equilibrium) -> Array:
    """Returns the start as a deviation from a rest; the history is still, and so is what counts of it."""
    parts = []
    for i, site in enumerate(now.sites):
        parts += [start.q[i] - rest.q[i], np.zeros(JOINTS)]
        if has_estimate(site):
            parts.append(start.theta_hat[i] - rest.theta_hat[i])
    return np.concatenate(parts)


def _kept(loop: LinearLoop, deviation: Array) -> Array | None:
    """Returns the part of a deviation that stays; None where roots at zero have too few vectors."""
    left, values, right = np.linalg.svd(build_static_matrix(loop))
    count = int(np.sum(values <= _FLAT * values[0]))
    if not count:
        return None
    W, V = left[:, -count:], right[-count:].T
    D = np.eye(len(values))
    for delayed in loop.delayed:
        D += delayed.delay_s * delayed.A
    inner = W.T @ D @ V
    if np.linalg.cond(inner) > 1.0 / _FLAT:
        return None
    found: Array = V @ np.linalg.solve(inner, W.T @ D @ deviation)
    return found


MAX_EQUILIBRIUM_RESIDUAL = 1e-10
"""The largest residual of a rest."""


def find_equilibrium(scenario: Scenario, pose: tuple[float, float] | None = None) -> Equilibrium:
    """Returns where a scenario's sites rest.

    Args:
        scenario: the experiment.
        pose: a pose for all sites, rad, with estimates that are the truth; None: where a run of it ends.

    Raises:
        ScenarioError: the scenario has no linear loop, or rests nowhere.
        UsageError: the pose is none.
    """
    now = derive_operating_conditions(scenario)
    found = _at_end(scenario, now) if pose is None else _at(pose, now)
    return found._replace(notes=tuple(_remarks(now, found)))


def predict_equilibrium(scenario: Scenario) -> Equilibrium:
    """Returns where a scenario would rest by its linear loop, without a run of it.

    Raises:
        ScenarioError: the scenario has no linear loop, or rests nowhere.
    """
    now = derive_operating_conditions(scenario)
    return _checked(scenario, predict_from_start(now, _start(now, scenario)))


def _start(now: OperatingConditions, scenario: Scenario) -> Equilibrium:
    """Returns the start poses, still, with estimates that are the truth."""
    q = np.array([spec.q0_rad for spec in scenario.sites.values()])
    return Equilibrium(q, _estimates(now, np.array([site.theta for site in now.sites])), "", 0.0)


def follow_equilibrium(scenario: Scenario, rest: Equilibrium) -> Equilibrium:
    """Returns the rest of a scenario that is next to that of another one; the same where nothing changed.

    Raises:
        ScenarioError: the scenario has no linear loop, or rests nowhere.
    """
    now = derive_operating_conditions(scenario)
    start = rest._replace(theta_hat=_estimates(now, rest.theta_hat))
    if float(np.abs(compute_equilibrium_residual(now, start)).max()) <= MAX_EQUILIBRIUM_RESIDUAL:
        return start
    return _checked(scenario, find_nearest_equilibrium(now, start))


def holds_any_shared_pose(now: OperatingConditions) -> bool:
    """True where no site learns and nobody is at the arms: then a pose that all share is an equilibrium."""
    return all(site.gains.law is Law.KNOWN and not site.actors for site in now.sites)


def _estimates(now: OperatingConditions, theta_hat: Array) -> Array:
    """Returns estimates with those of laws that learn nothing as the laws have them."""
    rows = [theta_hat[i] if has_estimate(site) else site.gains.known for i, site in enumerate(now.sites)]
    return np.array(rows, dtype=np.float64)


def _at(pose: tuple[float, float], now: OperatingConditions) -> Equilibrium:
    """Returns one pose for all sites."""
    if len(pose) != 2 or not np.isfinite(pose).all():
        raise UsageError(f"--pose is two angles in rad, as in --pose 0.1,0.3, not {pose}")
    q = np.tile(np.array(pose, dtype=np.float64), (len(now.sites), 1))
    theta = np.array([site.theta for site in now.sites])
    rest = Equilibrium(q, _estimates(now, theta), "the pose that was asked for, with theta_hat = theta", 0.0)
    return rest._replace(residual=float(np.abs(compute_equilibrium_residual(now, rest)).max()))


def _at_end(scenario: Scenario, now: OperatingConditions) -> Equilibrium:
    """Returns the equilibrium that a run leads to."""
    end = run_to_equilibrium(scenario)
    if end.diverged:
        found = predict_from_start(now, _start(now, scenario))
        return _checked(scenario, found._replace(how=f"the run diverges at {end.t_s:.4g} s; {found.how}"))
    if end.at_rest:
        how = f"the run is at rest at {end.t_s:.4g} s (slower than {EQUILIBRIUM_SPEED_RAD_S:g} rad/s)"
        return _checked(
            scenario,
            find_nearest_equilibrium(now, Equilibrium(end.q, _estimates(now, end.theta_hat), how, 0.0)),
        )
    how = (
        f"the run still moves at {end.t_s:.4g} s ({end.speed_rad_s:.2g} rad/s): the equilibrium next to the "
        "mean of its last quarter"
    )
    return _checked(
        scenario,
        find_nearest_equilibrium(now, Equilibrium(end.mean_q, _estimates(now, end.mean_theta_hat), how, 0.0)),
    )


def _checked(scenario: Scenario, rest: Equilibrium) -> Equilibrium:
    if not rest.residual <= MAX_EQUILIBRIUM_RESIDUAL:
        raise ScenarioError(
            f"the loop rests nowhere near where its run ends ({rest.residual:.2g} rad/s^2 are left); give a "
            "pose, as in --pose 0.1,0.3",
            source=scenario.name,
        )
    return rest


def _remarks(now: OperatingConditions, rest: Equilibrium) -> Iterator[str]:
    """Yields what is to be said of a rest."""
    if rest.residual > MAX_EQUILIBRIUM_RESIDUAL:
        yield (
            f"the pose is no rest: accelerations or rates of {rest.residual:.2g} are left there, and the "
            "roots are those of equations frozen at it"
        )
    x = gather_site_arguments(now, rest)
    for i, site in enumerate(now.sites):
        torque_nm = float(np.abs(now.rates(i, x[i]).tau).max())
        if torque_nm >= site.tau_limit_nm:
            yield (
                f"{site.name} needs {torque_nm:.4g} N m to rest, and its clamp is {site.tau_limit_nm:g}: "
                "the clamp is not in here"
            )
        yield from describe_switching_points(site, x[i])


def prolong_scenario(scenario: Scenario, duration_s: float) -> Scenario:
    """Returns the same experiment gone on for longer, with nothing new after its end.

    Args:
        scenario: the experiment.
        duration_s: for how long, s.
    """
    end_s = scenario.duration_s

    def on(actors: tuple[msgspec.Struct, ...]) -> tuple[msgspec.Struct, ...]:
        begun = [actor for actor in actors if getattr(actor, "start_s", 0.0) <= end_s]
        return tuple(
            msgspec.structs.replace(actor, end_s=1e9)
            if getattr(actor, "end_s", 0.0) > end_s and hasattr(actor, "stiffness_nm_rad")
            else actor
            for actor in begun
        )

    sites = {
        name: msgspec.structs.replace(spec, hands=on(spec.hands), environment=on(spec.environment))
        for name, spec in scenario.sites.items()
    }
    timeline = tuple(change for change in scenario.timeline if change.at_s <= end_s)
    return msgspec.structs.replace(scenario, sites=sites, timeline=timeline, duration_s=duration_s)
