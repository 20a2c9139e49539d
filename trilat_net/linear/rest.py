"""Where a loop rests, and how that was found.

Law: what is returned is an equilibrium of the equations to 1e-10, or says in a note that it is none.
"""

from collections.abc import Iterator

import numpy as np

from ..core.arm import Array
from ..core.setup import Law
from ..errors import ScenarioError, UsageError
from ..scenario import Scenario
from .conditions import Conditions, conditions
from .ending import STILL_RAD_S, ending_of
from .equilibrium import nearest, predicted, residual_of
from .field import adapts, edges
from .loop import Rest, arguments

RESTS = 1e-10
"""The largest residual of a rest."""


def rest_of(scenario: Scenario, pose: tuple[float, float] | None = None) -> Rest:
    """Returns where a scenario's sites rest.

    Args:
        scenario: the experiment.
        pose: a pose for all sites, rad, with estimates that are the truth; None: where a run of it ends.

    Raises:
        ScenarioError: the scenario has no linear loop, or rests nowhere.
        UsageError: the pose is none.
    """
    now = conditions(scenario)
    found = _at_end(scenario, now) if pose is None else _at(pose, now)
    return found._replace(notes=tuple(_remarks(now, found)))


def predicted_rest(scenario: Scenario) -> Rest:
    """Returns where a scenario would rest by its linear loop, without a run of it.

    Raises:
        ScenarioError: the scenario has no linear loop, or rests nowhere.
    """
    now = conditions(scenario)
    return _checked(scenario, predicted(now, _start(now, scenario)))


def _start(now: Conditions, scenario: Scenario) -> Rest:
    """Returns the start poses, still, with estimates that are the truth."""
    q = np.array([spec.q0_rad for spec in scenario.sites.values()])
    return Rest(q, _estimates(now, np.array([site.theta for site in now.sites])), "", 0.0)


def rest_near(scenario: Scenario, rest: Rest) -> Rest:
    """Returns the rest of a scenario that is next to that of another one; the same where nothing changed.

    Raises:
        ScenarioError: the scenario has no linear loop, or rests nowhere.
    """
    now = conditions(scenario)
    start = rest._replace(theta_hat=_estimates(now, rest.theta_hat))
    if float(np.abs(residual_of(now, start)).max()) <= RESTS:
        return start
    return _checked(scenario, nearest(now, start))


def knows_gravity(now: Conditions) -> bool:
    """True where no site learns and nobody is at the arms: then a pose that all share is an equilibrium."""
    return all(site.gains.law is Law.KNOWN and not site.actors for site in now.sites)


def _estimates(now: Conditions, theta_hat: Array) -> Array:
    """Returns estimates with those of laws that learn nothing as the laws have them."""
    rows = [theta_hat[i] if adapts(site) else site.gains.known for i, site in enumerate(now.sites)]
    return np.array(rows, dtype=np.float64)


def _at(pose: tuple[float, float], now: Conditions) -> Rest:
    """Returns one pose for all sites."""
    if len(pose) != 2 or not np.isfinite(pose).all():
        raise UsageError(f"--pose is two angles in rad, as in --pose 0.1,0.3, not {pose}")
    q = np.tile(np.array(pose, dtype=np.float64), (len(now.sites), 1))
    theta = np.array([site.theta for site in now.sites])
    rest = Rest(q, _estimates(now, theta), "the pose that was asked for, with theta_hat = theta", 0.0)
    return rest._replace(residual=float(np.abs(residual_of(now, rest)).max()))


def _at_end(scenario: Scenario, now: Conditions) -> Rest:
    """Returns the equilibrium that a run leads to."""
    end = ending_of(scenario)
    if end.diverged:
        found = predicted(now, _start(now, scenario))
        return _checked(scenario, found._replace(how=f"the run diverges at {end.t_s:.4g} s; {found.how}"))
    if end.at_rest:
        how = f"the run is at rest at {end.t_s:.4g} s (slower than {STILL_RAD_S:g} rad/s)"
        return _checked(scenario, nearest(now, Rest(end.q, _estimates(now, end.theta_hat), how, 0.0)))
    how = (
        f"the run still moves at {end.t_s:.4g} s ({end.speed_rad_s:.2g} rad/s): the equilibrium next to the "
        "mean of its last quarter"
    )
    return _checked(scenario, nearest(now, Rest(end.mean_q, _estimates(now, end.mean_theta_hat), how, 0.0)))


def _checked(scenario: Scenario, rest: Rest) -> Rest:
    if not rest.residual <= RESTS:
        raise ScenarioError(
            f"the loop rests nowhere near where its run ends ({rest.residual:.2g} rad/s^2 are left); give a "
            "pose, as in --pose 0.1,0.3",
            source=scenario.name,
        )
    return rest


def _remarks(now: Conditions, rest: Rest) -> Iterator[str]:
    """Yields what is to be said of a rest."""
    if rest.residual > RESTS:
        yield (
            f"the pose is no rest: accelerations or rates of {rest.residual:.2g} are left there, and the "
            "roots are those of equations frozen at it"
        )
    x = arguments(now, rest)
    for i, site in enumerate(now.sites):
        torque_nm = float(np.abs(now.rates(i, x[i]).tau).max())
        if torque_nm >= site.tau_limit_nm:
            yield (
                f"{site.name} needs {torque_nm:.4g} N m to rest, and its clamp is {site.tau_limit_nm:g}: "
                "the clamp is not in here"
            )
        yield from edges(site, x[i])
