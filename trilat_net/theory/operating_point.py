"""The operating point of the linear loop: conditions at the end of a run, and the equilibrium.

Invariant: a linear loop has one set of numbers, those in force at the end of the run. Earlier or random
values are reported in a note; values that cannot be known beforehand are refused.
"""

import math
from typing import NamedTuple

import numpy as np

from ..core.exogenous import TorqueKind, TorqueSource
from ..core.site_setup import SiteSetup, StaleAction
from ..core.vectors import Array
from ..errors import ScenarioError
from ..scenario import Scenario
from ..scenario.delay_models import LinkBase
from ..scenario.laws import ImportedLaw
from ..scenario.scenario_types import scheduled_links
from .effective_delay import EffectiveDelay, compute_effective_delay
from .site_dynamics import SiteRates, evaluate_site_rates
from .textbook_arm import Numbers


class OperatingConditions(NamedTuple):
    """What the linear loop is made of.

    Attributes:
        sites: what they are built from, in scenario order; their actors are those in force.
        alpha: who follows whom, shape (N, N), Eq. (6).
        age_s: how old the sample of j that i uses is, shape (N, N), s; 0 where it uses none.
        notes: what is to be said of all that.
    """

    sites: tuple[SiteSetup, ...]
    alpha: Array
    age_s: Array
    notes: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites, in order."""
        return tuple(site.name for site in self.sites)

    def rates(self, i: int, x: Numbers) -> SiteRates:
        """Returns the rates of a site, see `field.rates`."""
        return evaluate_site_rates(self.sites[i], x)


def derive_operating_conditions(scenario: Scenario) -> OperatingConditions:
    """Returns what holds at the end of a run.

    Args:
        scenario: the experiment.

    Raises:
        ScenarioError: a law is from outside, an arm is outside, or a link is measured.
    """
    _refuse(scenario)
    notes: list[str] = []
    sites = tuple(_site(scenario, name, notes) for name in scenario.names)
    alpha = _shares(scenario, sites, notes)
    age_s = np.zeros_like(alpha)
    found = {
        (i, j): _age(scenario, scenario.names[j], scenario.names[i], notes)
        for i, j in zip(*np.nonzero(alpha), strict=True)
    }
    for (i, j), age in found.items():
        age_s[i, j] = age.mean_s
    notes += _varying([age for age in found.values() if age.most_s > age.least_s])
    if any(site.on_stale.action is not StaleAction.USE for site in sites):
        notes.append("rules for stale peers are left out: no peer counts as stale")
    return OperatingConditions(sites, alpha, age_s, tuple(dict.fromkeys(notes)))


def _refuse(scenario: Scenario) -> None:
    for name, spec in scenario.sites.items():
        if isinstance(spec.control, ImportedLaw):
            raise ScenarioError(
                f"{spec.control.code} is a law from outside, whose equations nobody here knows; linearised "
                "are adaptive, adaptive_box, p_d, pd_d and p_f",
                path=f"sites.{name}.control.law",
                source=scenario.name,
            )
    for name in scenario.external:
        raise ScenarioError(
            "is external: nobody here knows the equations of that arm; simulate it with plant = 'simulated'",
            path=f"sites.{name}.plant",
            source=scenario.name,
        )


def find_final_link(scenario: Scenario, name: str) -> LinkBase:
    """Returns what a link is at the end of a run."""
    end_ns = round(scenario.duration_s * 1e9)
    link: LinkBase = scenario.links[name]
    for from_ns, later in scheduled_links(scenario.timeline, name):
        link = later if from_ns <= end_ns else link
    return link


def _age(scenario: Scenario, peer: str, site: str, notes: list[str]) -> EffectiveDelay:
    """Returns how old the samples of a link are when they are used."""
    name = f"{peer}->{site}"
    link = find_final_link(scenario, name)
    if link.measured:
        raise ScenarioError(
            "is 'measured': nobody knows its delay beforehand; give a model, as in link.model = 'constant'",
            path=f"links.{name}.model",
            source=scenario.name,
        )
    if link != scenario.links[name]:
        notes.append(f"link {name} changes during the run: taken as it is at the end, {link.describe()}")
    if link.outages_s:
        notes.append(f"the outages of link {name} are not in here")
    return compute_effective_delay(scenario, peer, site, link)


def _varying(ages: list[EffectiveDelay]) -> list[str]:
    """Returns what is to be said of links whose samples are not always equally old."""
    if not ages:
        return []
    least, most = 1e3 * min(age.least_s for age in ages), 1e3 * max(age.most_s for age in ages)
    links = "one link" if len(ages) == 1 else f"{len(ages)} links"
    return [
        f"the age of the samples in use varies on {links}, {least:.4g} to {most:.4g} ms: linearised at the "
        "mean of each; what the variation itself does is not in here"
    ]


def _shares(scenario: Scenario, sites: tuple[SiteSetup, ...], notes: list[str]) -> Array:
    """Returns the dominance matrix as it is at the end of the run."""
    alpha = scenario.alpha.copy()
    end_ns = round(scenario.duration_s * 1e9)
    for i, site in enumerate(sites):
        peers = [scenario.names.index(link.peer) for link in site.links]
        for ramp in site.ramps:
            if ramp.start_ns > end_ns:
                continue
            whole = ramp.end_ns <= end_ns
            way = 1.0 if whole else (end_ns - ramp.start_ns) / (ramp.end_ns - ramp.start_ns)
            alpha[i, peers] += way * (np.array(ramp.alpha) - alpha[i, peers])
            notes.append(f"the shares of {site.name} change during the run: taken as they are at the end")
    return alpha


def _site(scenario: Scenario, name: str, notes: list[str]) -> SiteSetup:
    """Returns a site with the actors that are in force at the end."""
    setup = scenario.setup(name)
    end_s = scenario.duration_s
    present = [actor for actor in setup.actors if _present(actor, end_s)]
    hands = [actor for actor in present if actor.acts in (TorqueKind.HAND, TorqueKind.TASK_HAND)]
    if any(hand.move_end_s > end_s for hand in hands):
        notes.append(f"a hand of {name} still moves at the end: taken to be where it moves to")
    scripted = [actor for actor in present if actor.acts in (TorqueKind.PULSE, TorqueKind.RECORDED)]
    still = [actor._replace(a=_torque_at(actor, end_s)) for actor in scripted]
    if any(any(actor.a) for actor in still):
        notes.append(f"a scripted torque acts on {name} at the end: taken to stay as it is then")
    return setup._replace(actors=tuple(actor for actor in present if actor not in scripted) + tuple(still))


def _present(actor: TorqueSource, t_s: float) -> bool:
    return actor.start_s <= t_s < actor.end_s


def _torque_at(actor: TorqueSource, t_s: float) -> tuple[float, ...]:
    """Returns what a script does at a time, N m."""
    if actor.table is None:
        x = (t_s - actor.start_s) / (actor.end_s - actor.start_s)
        return tuple(peak * math.sin(math.pi * x) ** 2 for peak in actor.a)
    t, *torques = actor.table.T
    return tuple(float(np.interp(t_s, t, torque, left=0.0, right=0.0)) for torque in torques)


class Equilibrium(NamedTuple):
    """Where a loop is linearised: all sites still.

    Attributes:
        q: joint angles, shape (N, 2), rad.
        theta_hat: estimates, shape (N, 5); of a law that knows gravity what it takes the arm to have.
        how: how it was found, in words.
        residual: the largest acceleration, rad/s^2, or rate of an estimate that is left there.
        notes: what is to be said of it.
    """

    q: Array
    theta_hat: Array
    how: str
    residual: float
    notes: tuple[str, ...] = ()
