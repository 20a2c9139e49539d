"""The operating point of the linear loop: conditions at the end of a run, and the equilibrium.

Invariant: a linear loop has one set of numbers, those in force at the end of the run. Earlier
or random values are reported in a note; values that cannot be known beforehand are refused.

A link has an effective delay (L2): the age of its samples at the ticks that use them. With a
constant delay and equal rates it is max(1, ceil(T / h)) ticks; in all other cases it is
averaged over the same random draws as a run makes.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..core.delay import DelayKind
from ..core.exogenous import LIVE_KINDS, OWN_KINDS, SCRIPTED_KINDS, TorqueKind, TorqueSource
from ..core.philox import link_key
from ..core.site_setup import Gains, Scheme, SiteSetup, StaleAction
from ..core.ticks import NS_PER_S
from ..core.vectors import Array
from ..errors import ScenarioError, count_nouns
from ..files import find_page
from ..laws.conditions import LinearForm, LinearSituation
from ..scenario import Scenario
from ..scenario.delay_models import LinkBase
from ..scenario.imported_code import ImportedLaw
from ..scenario.sample_uses import draw_used_samples
from ..scenario.scenario_types import scheduled_links
from ..scenario.validate import refuse_external_arms
from .numeric_law import NumericLaw
from .site_dynamics import SiteRates, evaluate_site_rates


class Equilibrium(NamedTuple):
    """The pose about which a loop is linearised, all sites at rest.

    Attributes:
        q: joint angles, shape (N, n), rad; of arms with fewer joints followed by zeros.
        theta_hat: estimates, shape (N, P), so as well; of a law that knows gravity what it
            assumes.
        how: the way it was found, in words.
        residual: the largest remaining acceleration, rad/s^2, or rate of an estimate.
        notes: remarks on it.
    """

    q: Array
    theta_hat: Array
    how: str
    residual: float
    notes: tuple[str, ...] = ()


class EffectiveDelay(NamedTuple):
    """Age of the samples in use over the receiver's ticks: mean, least and largest, s."""

    mean_s: float
    least_s: float
    most_s: float


class OperatingConditions(NamedTuple):
    """The numbers that the linear loop is built from.

    Attributes:
        sites: setups in scenario order, with the actors in force.
        alpha: dominance matrix, shape (N, N), Eq. (6).
        age_s: age of the sample of j that i uses, shape (N, N), s; 0 where it uses none.
        notes: remarks on what was left out or fixed.
        varying: True if ages vary, and `age_s` holds their means.
        laws: the control of each site.
        links: the link from j to i in force and the key of its draws, by (i, j).
    """

    sites: tuple[SiteSetup, ...]
    alpha: Array
    age_s: Array
    notes: tuple[str, ...]
    varying: bool = False
    laws: tuple[Any, ...] = ()
    links: Mapping[tuple[int, int], tuple[LinkBase, int]] = MappingProxyType({})

    def find_forms(self, inertia: Sequence[Array] = ()) -> list[LinearForm | None]:
        """Returns what laws add to their gains in small motions, with the inertia of their
        arms.
        """
        forms: list[LinearForm | None] = []
        for n, law in enumerate(self.laws):
            M = inertia[n] if inertia else np.eye(self.sites[n].layout.joints)
            situation = LinearSituation(
                site=n, names=self.names, laws=self.laws, alpha=self.alpha, inertia=M
            )
            forms.append(law.linear_form(situation))
        return forms

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Who follows whom, as (i, j): by a dominance factor, or since a law of one's own sees
        every peer.
        """
        sees = np.array([isinstance(site.own, NumericLaw) for site in self.sites])[
            :, np.newaxis
        ]
        linked = (self.alpha != 0.0) | (sees & ~np.eye(len(self.alpha), dtype=bool))
        return [(int(i), int(j)) for i, j in zip(*np.nonzero(linked), strict=True)]

    @property
    def has_forms(self) -> bool:
        """True if a law has states of its own, or sends more than samples have: then time is
        continuous.
        """
        return any(form is not None for form in self.find_forms())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites, in order."""
        return tuple(site.name for site in self.sites)

    @property
    def held(self) -> bool:
        """True if the sampled loop alone tells what the tick does: digital controllers, sampled
        actors.

        Or what ages do that vary and are not drawn.
        """
        known = self.varying and not any(link.random for link, _ in self.links.values())
        digital = self.sites[0].scheme is Scheme.DIGITAL
        return (
            known
            or digital
            or any(actor.sampled for site in self.sites for actor in site.actors)
        )

    def rates(self, x: Sequence[Array]) -> list[SiteRates]:
        """Returns the rates of every site at its own arguments, see `evaluate_site_rates`."""
        return [evaluate_site_rates(site, own) for site, own in zip(self.sites, x, strict=True)]


def derive_operating_conditions(
    scenario: Scenario, *, own_laws: bool = True
) -> OperatingConditions:
    """Returns the conditions at the end of a run; `own_laws`: the code of imported laws may
    run.

    Raises:
        ScenarioError: a law has no linear loop, an arm is external, or a link is measured.
    """
    gains = _find_linear_gains(scenario, own_laws=own_laws)
    notes: list[str] = []
    sites = tuple(
        _select_final_actors(scenario, name, notes)._replace(gains=gains[name])
        for name in scenario.names
    )
    alpha = _final_dominance(scenario, sites, notes)
    age_s = np.zeros_like(alpha)
    varying = []
    laws = scenario.controls
    sites = tuple(_make_own_law(scenario, site, alpha) for site in sites)
    codes = [law.code if isinstance(law, ImportedLaw) else "" for law in laws]
    for code in filter(None, dict.fromkeys(codes)):
        owners = ", ".join(
            name for name, one in zip(scenario.names, codes, strict=True) if one == code
        )
        notes.append(
            f"{code} of {owners} is differentiated numerically, its memory too: central differences"
        )
    notes += [law.linear_note for law in laws if law.linear_note]
    conditions = OperatingConditions(sites, alpha, age_s, (), laws=laws)
    pairs = conditions.pairs
    if conditions.has_forms:
        pairs = [(i, j) for i in range(len(alpha)) for j in range(len(alpha)) if i != j]
        notes.append(
            "a law here has states or waves of its own: it is linearised in continuous time alone"
        )
    links = {}
    for i, j in pairs:
        peer = scenario.names[j]
        own = scenario.names[i]
        link = _find_final_link(scenario, f"{peer}->{own}", notes)
        links[i, j] = link, link_key(scenario.seed, f"{peer}->{own}")
        age = compute_effective_delay(scenario, peer, own, link)
        age_s[i, j] = age.mean_s
        if age.most_s > age.least_s + 1e-8:  # more than ticks in whole ns
            varying.append(age)
    if varying:
        least = 1e3 * min(age.least_s for age in varying)
        most = 1e3 * max(age.most_s for age in varying)
        where = "one link" if len(varying) == 1 else f"{count_nouns(len(varying), 'link')}"
        notes.append(
            f"the age of the samples in use varies on {where}, {least:.4g} to {most:.4g} ms: the continuous "
            "loop is linearised at the mean of each, and leaves out the effect of the variation itself"
        )
    if any(site.on_stale.action is not StaleAction.USE for site in sites):
        notes.append("rules for stale peers are left out: no peer counts as stale")
    return conditions._replace(
        notes=tuple(dict.fromkeys(notes)), varying=bool(varying), links=links
    )


def is_constant_link(link: LinkBase) -> bool:
    """True if a link delays every sample alike."""
    return (
        link.to_core_model().kind == DelayKind.CONSTANT and not link.loss and not link.measured
    )


def _make_own_law(scenario: Scenario, site: SiteSetup, alpha: Array) -> SiteSetup:
    """Returns a site whose law, if it is imported, is made, to be asked."""
    law = scenario.sites[site.name].control
    i = scenario.names.index(site.name)
    if not isinstance(law, ImportedLaw):
        return site
    try:
        return site._replace(own=NumericLaw(site, law.code, np.delete(alpha[i], i).tolist()))
    except ScenarioError as error:
        raise type(error)(error.problem, path=error.path, source=scenario.name) from None


def _find_linear_gains(scenario: Scenario, *, own_laws: bool) -> dict[str, Gains]:
    found: dict[str, Gains] = {}
    for name, spec in scenario.sites.items():
        law = spec.control
        theta = scenario.arms[name].theta
        gains = law.linear_gains(theta)
        if own_laws and isinstance(law, ImportedLaw):
            gains = law.gains(theta)
        if gains is None:
            why = law.explain_no_linear_form()
            if isinstance(law, ImportedLaw):
                why = f"{law.code} is known by its code alone, which trilat linear runs, and this does not"
            others = f"adaptive, adaptive_box, p_d, pd_d, p_f and others have one, see {find_page('laws.md')}"
            raise ScenarioError(
                f"has no linear loop: {why or others}",
                path=f"sites.{name}.control.law",
                source=scenario.name,
            )
        found[name] = gains
    refuse_external_arms(scenario)
    return found


def _find_final_link(scenario: Scenario, name: str, notes: list[str]) -> LinkBase:
    end_ns = round(scenario.duration_s * 1e9)
    link: LinkBase = scenario.links[name]
    for from_ns, later in scheduled_links(scenario.timeline, name):
        link = later if from_ns <= end_ns else link
    if link.measured:
        raise ScenarioError(
            "is 'measured': its delay is not known beforehand; give a model, as in link.model = 'constant'",
            path=f"links.{name}.model",
            source=scenario.name,
        )
    if link != scenario.links[name]:
        notes.append(
            f"link {name} changes during the run: taken as it is at the end, {link.describe()}"
        )
    if link.outages_s:
        notes.append(f"the outages of link {name} are left out")
    return link


def compute_effective_delay(
    scenario: Scenario, peer: str, site: str, link: LinkBase
) -> EffectiveDelay:
    """Returns the age of a peer's samples at the ticks of a site that use them.

    Raises:
        ScenarioError: no sample ever arrives.
    """
    own_hz = scenario.sites[site].rate_hz
    peer_hz = scenario.sites[peer].rate_hz
    model = link.to_core_model()
    constant = is_constant_link(link)
    if constant and own_hz == peer_hz:
        delay_us = max(round(model.location), model.playout_us)
        age_s = max(1, -(-delay_us * own_hz // 1_000_000)) / own_hz
        return EffectiveDelay(age_s, age_s, age_s)
    duration_s = (
        min(scenario.duration_s, 2.0 + 2e-6 * model.location)
        if constant
        else scenario.duration_s
    )
    used = draw_used_samples(
        link=link,
        key=link_key(scenario.seed, f"{peer}->{site}"),
        own_hz=own_hz,
        peer_hz=peer_hz,
        duration_s=duration_s,
    )
    if used[-1] < 0:
        raise ScenarioError(
            "no sample of it ever comes", path=f"links.{peer}->{site}", source=scenario.name
        )
    first = int(np.argmax(used >= 0))
    now_ns = np.arange(first, len(used)) * NS_PER_S // own_hz
    ages_s = (now_ns - used[first:] * NS_PER_S // peer_hz) * 1e-9
    return EffectiveDelay(float(ages_s.mean()), float(ages_s.min()), float(ages_s.max()))


def _final_dominance(
    scenario: Scenario, sites: tuple[SiteSetup, ...], notes: list[str]
) -> Array:
    alpha = scenario.alpha.copy()
    end_ns = round(scenario.duration_s * 1e9)
    for i, site in enumerate(sites):
        peers = [scenario.names.index(link.peer) for link in site.links]
        for ramp in site.ramps:
            if ramp.start_ns > end_ns:
                continue
            over = ramp.end_ns <= end_ns
            share = 1.0 if over else (end_ns - ramp.start_ns) / (ramp.end_ns - ramp.start_ns)
            alpha[i, peers] += share * (np.array(ramp.alpha) - alpha[i, peers])
            notes.append(
                f"the dominance factors of {site.name} change during the run: taken as they are at the end"
            )
    return alpha


def _select_final_actors(scenario: Scenario, name: str, notes: list[str]) -> SiteSetup:
    setup = scenario.setup(name)
    end_s = scenario.duration_s
    present = [actor for actor in setup.actors if actor.start_s <= end_s < actor.end_s]
    if any(
        actor.acts in (TorqueKind.HAND, TorqueKind.TASK_HAND) and actor.move_end_s > end_s
        for actor in present
    ):
        notes.append(
            f"an operator at {name} still moves at the end: taken to be at the end of that motion"
        )
    if any(actor.acts in _PERIODIC for actor in present):
        notes.append(
            f"an operator at {name} still swings at the end: left out, its torque has no mean"
        )
    scripted = [
        actor
        for actor in present
        if actor.acts in SCRIPTED_KINDS and actor.acts not in _PERIODIC
    ]
    constant = [actor._replace(a=_scripted_torque(actor, end_s)) for actor in scripted]
    if any(any(actor.a) for actor in constant):
        notes.append(
            f"a scripted torque acts on {name} at the end: taken to stay as it is then"
        )
    own = (actor._replace(move_end_s=end_s) for actor in present if actor.acts in OWN_KINDS)
    others = (
        actor
        for actor in present
        if actor.acts not in (*SCRIPTED_KINDS, *OWN_KINDS, *LIVE_KINDS)
    )
    return setup._replace(actors=(*others, *own, *constant))


_PERIODIC = (TorqueKind.CHIRP, TorqueKind.MULTISINE)


def _scripted_torque(actor: TorqueSource, t_s: float) -> tuple[float, ...]:
    if actor.table is None:
        x = (t_s - actor.start_s) / (actor.end_s - actor.start_s)
        return tuple(peak * math.sin(math.pi * x) ** 2 for peak in actor.a)
    t, *torques = actor.table.T
    return tuple(float(np.interp(t_s, t, torque, left=0.0, right=0.0)) for torque in torques)
