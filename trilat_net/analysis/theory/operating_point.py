"""Determines the delays, weights and operators with which the control loop is linearised.

Delays, weights and operators may change during a run, but a linear loop has only one set of
them, its operating point. It consists of the values at the end of the run.

The effective delay of a link is the age of the state that the receiver uses at a tick. It may
be longer than the network delay T, because a controller uses a state only at its next tick.
With a constant delay and the same tick period h at both ends, it is max(1, ceil(T / h)) ticks.
Otherwise it is the mean over the same random delays as in a run.

Invariant:
    - A note reports every value that differed earlier in the run or that is random.
    - An operating point that cannot be known before the run is rejected.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import permutations
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core import (
    LIVE_KINDS,
    OWN_KINDS,
    SCRIPTED_KINDS,
    Array,
    Gains,
    SiteSetup,
    TorqueKind,
    TorqueSource,
    link_key,
)
from ...errors import ScenarioError, count_nouns
from ...files import find_page
from ...laws import LinearForm
from ...records import NS_PER_S
from ...scenario import LinkBase, Scenario
from ..delay_period import MAX_PERIOD_TICKS
from .numeric_law import NumericLaw
from .site_dynamics import (
    ArgumentLayout,
    SiteRates,
    compute_reflected_torque,
    compute_shared_pose,
    has_estimate,
)
from .textbook_arm import evaluate_reference


class Equilibrium(NamedTuple):
    """Pose in which all arms are at rest, about which their motion is linearised.

    Attributes:
        q: Joint angles, shape (N, n), in rad. Rows of arms with fewer joints are padded with
            zeros.
        theta_hat: Estimates of the arm parameters, shape (N, P), also padded with zeros. For a
            law with known gravity, these are the parameters that the law assumes, and for an
            imported law, its memory.
        how: A phrase on how the equilibrium was determined.
        residual: Largest remaining acceleration, in rad/s^2, or rate of an estimate.
        notes: Remarks on the equilibrium.
    """

    q: Array
    theta_hat: Array
    how: str
    residual: float
    notes: tuple[str, ...] = ()


class _EffectiveDelay(NamedTuple):
    """Age of the messages that a control loop uses: mean, smallest and largest.

    The age is the network delay plus the wait for the next tick.

    Attributes:
        mean_s: Mean age, in s.
        least_s: Smallest age, in s.
        most_s: Largest age, in s.
    """

    mean_s: float
    least_s: float
    most_s: float

    @property
    def varies(self) -> bool:
        """True if the age of the used samples is not constant.

        Differences up to 10 ns are ignored: since tick times are rounded to nanoseconds, even
        constant ages differ slightly.
        """
        return self.most_s > self.least_s + 1e-8


class OperatingConditions(NamedTuple):
    """Gains, delays, weights and operators from which the linear model of the arms is built.

    The values are those at the end of a run of the scenario (see `OperatingConditions.derive`).
    N is the number of sites.

    Attributes:
        sites: Setups of the sites in scenario order, with the operators and environments in
            effect.
        alpha: Matrix of dominance factors, shape (N, N), Eq. (6). Entry (i, j) is the weight
            with which site i follows site j.
        age_s: Age of the sample of site j that site i uses, shape (N, N), in s. 0 if site i
            uses no sample of site j.
        notes: Remarks for the user on quantities that were left out or fixed.
        varying: True if ages vary during the run. `age_s` then contains their means.
        laws: Control law of each site.
        links: For each pair (i, j), the link from j to i that is in effect, and the key of its
            random draws.
    """

    sites: tuple[SiteSetup, ...]
    alpha: Array
    age_s: Array
    notes: tuple[str, ...]
    varying: bool = False
    laws: tuple[Any, ...] = ()
    links: Mapping[tuple[int, int], tuple[LinkBase, int]] = MappingProxyType({})

    def find_forms(self, inertia: Sequence[Array] = ()) -> list[LinearForm | None]:
        """Returns the linear equations of control laws that are not described by gains alone.

        Examples are laws that store values from tick to tick, or send waves. `LinearForm`
        represents their equations.

        Args:
            inertia: Inertia matrix of each arm, shape (n, n), for n joints. Empty for unit
                matrices.

        Returns:
            The equations for each site, or `None` for a site whose law is fully described by
            its gains.
        """
        inertia = inertia or [np.eye(site.layout.joints) for site in self.sites]
        return LinearForm.list_forms(self.names, self.laws, self.alpha, inertia)

    @property
    def coupled_pairs(self) -> list[tuple[int, int]]:
        """Pairs (i, j) of sites for which site i reacts to the states that site j sends.

        Site i reacts if its dominance factor for site j is not zero. A user's control law reads
        the states of all other sites and therefore always reacts.
        """
        pairs = []
        for i, site in enumerate(self.sites):
            is_imported = isinstance(site.law_factory, NumericLaw)
            for j, share in enumerate(self.alpha[i].tolist()):
                reads_all = is_imported and j != i
                if share != 0.0 or reads_all:
                    pairs.append((i, j))
        return pairs

    @property
    def has_forms(self) -> bool:
        """True if the control law of some arm is not described by gains alone.

        Examples are laws that store values from tick to tick, or send waves. The coupled arms
        are then linearised only in continuous time, and not tick by tick.
        """
        return any(form is not None for form in self.find_forms())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites, in scenario order."""
        return tuple(site.name for site in self.sites)

    @property
    def needs_sampled_loop(self) -> bool:
        """True if the controllers' ticks matter for stability and must therefore be modelled.

        Ticks matter in three cases:

        - The integration scheme is `digital`: zero-order hold, as in a plain digital
          controller.
        - A wall or an operator acts once per tick.
        - The delays vary in a known way rather than at random.
        """
        has_random_link = any(link.random for link, _ in self.links.values())
        if self.varying and not has_random_link:
            return True
        if self.sites[0].digital:
            return True
        actors = [actor for site in self.sites for actor in site.actors]
        return any(actor.sampled for actor in actors)

    def evaluate_rates(self, arguments: Sequence[Array]) -> list[SiteRates]:
        """Computes the accelerations of every arm and the rates of its parameter estimates.

        The states of an arm are its joint angles, its joint velocities and its parameter
        estimates.

        Args:
            arguments: States and inputs of each site, in the order of `ArgumentLayout`.

        Returns:
            The rates of change of each site, with its torques and outputs.
        """
        pairs = zip(self.sites, arguments, strict=True)
        return [SiteRates.evaluate(site, x) for site, x in pairs]

    def gather_site_arguments(self, rest: Equilibrium) -> list[Array]:
        """Collects the states and inputs of each site when all arms are at rest.

        The states are joint angles, joint velocities and parameter estimates. The inputs are
        the values that a site receives from the other sites, and the external torque.
        `ArgumentLayout` defines their order.

        Args:
            rest: The equilibrium, with the parameter estimates.

        Returns:
            One vector per site, with the length stated by its `ArgumentLayout`.
        """
        layouts = [ArgumentLayout.of_site(site) for site in self.sites]
        arguments = [np.zeros(layout.arguments) for layout in layouts]
        references = self.compute_references(rest)
        site_arguments = list(zip(layouts, arguments, strict=True))
        for i, (layout, x) in enumerate(site_arguments):
            q = rest.q[i]
            theta_hat = rest.theta_hat[i]
            x[layout.q] = q[: layout.joints]
            x[layout.estimate] = theta_hat[: layout.parameters]
            x[layout.q_des] = references[i]

        # the peers' torques follow from the arguments so far
        reflected = [
            compute_reflected_torque(site, x)
            for site, x in zip(self.sites, arguments, strict=True)
        ]
        peer_torques = self.alpha @ reflected
        for i, (layout, x) in enumerate(site_arguments):
            x[layout.peer_torque] = peer_torques[i]
            peers = [j for j in range(len(arguments)) if j != i]
            m = layout.coordinates
            qd = np.zeros(m)
            for index in range(layout.peers):
                j = peers[index]
                q = rest.q[j]
                torque = -reflected[j]
                sample = layout.peer_sample(index)
                x[sample] = np.concatenate([q[:m], qd, torque])
        return arguments

    def compute_shared_poses(self, rest: Equilibrium) -> list[Array]:
        """Computes the pose that each arm sends to the other arms while all arms are at rest.

        The pose of an arm is given by its joint angles, or in task space by its end effector.

        Args:
            rest: The equilibrium.

        Returns:
            One pose per site, shape (m,).
        """
        poses = []
        for site, q in zip(self.sites, rest.q, strict=True):
            joint_positions = q[: site.layout.joints]
            pose = compute_shared_pose(site, joint_positions)
            poses.append(pose)
        return poses

    def compute_references(self, rest: Equilibrium) -> list[Array]:
        """Computes the pose that the control law of each arm tries to reach at rest.

        This pose, the reference, is the mean of the other arms' poses, weighted with the
        dominance factors.

        Args:
            rest: The equilibrium.

        Returns:
            One reference per site, shape (m,).
        """
        poses = self.compute_shared_poses(rest)
        if not self.sites[0].layout.task:
            references = self.alpha @ np.array(poses)
            return list(references)
        pairs = zip(self.alpha, poses, strict=True)
        return [evaluate_reference(shares, pose, poses) for shares, pose in pairs]

    def mask_loop_states(self) -> list[NDArray[np.bool_]]:
        """Finds which states of each site belong to the linear model of the coupled arms.

        Joint angles and velocities always belong to the model. The parameter estimates, or the
        memory of a user's control law, belong to it if the control law changes them.

        Returns:
            For each site, a boolean mask over its states (angles, velocities, estimates), shape
            (states,).
        """
        masks = []
        for site in self.sites:
            layout = ArgumentLayout.of_site(site)
            mask = np.ones(layout.states, dtype=bool)
            mask[layout.estimate] = has_estimate(site)
            masks.append(mask)
        return masks

    @classmethod
    def derive(cls, scenario: Scenario, *, own_laws: bool = True) -> "OperatingConditions":
        """Collects the data for a scenario's linear model, as they are at the end of a run.

        The data are the delays, dominance factors, gains and operators after all planned
        changes.

        Args:
            scenario: The scenario.
            own_laws: True if the code of imported control laws may be executed.

        Raises:
            ScenarioError: A law cannot be linearised, an arm is not simulated, or the delay of
                a link is measured during the run.
        """
        gains = _find_linear_gains(scenario, own_laws=own_laws)
        notes: list[str] = []
        sites = tuple(
            _select_final_actors(scenario, name, notes)._replace(gains=gains[name])
            for name in scenario.names
        )

        alpha = _find_final_dominance(scenario, sites, notes)
        age_s = np.zeros_like(alpha)
        laws = scenario.controls
        sites = tuple(_build_imported_law(scenario, site, alpha) for site in sites)
        notes += _describe_laws(scenario)

        conditions = OperatingConditions(sites, alpha, age_s, (), laws=laws)
        pairs = conditions.coupled_pairs
        if conditions.has_forms:
            pairs = list(permutations(range(len(alpha)), 2))
            notes.append(
                "a law has additional states or waves: it is linearised in continuous time only"
            )

        links = {}
        varying = []
        for i, j in pairs:
            peer = scenario.names[j]
            site = scenario.names[i]
            link = _find_final_link(scenario, f"{peer}->{site}", notes)
            links[i, j] = link, link_key(scenario.seed, f"{peer}->{site}")
            age = compute_effective_delay(scenario, peer, site, link)
            age_s[i, j] = age.mean_s
            rate_hz = max(scenario.sites[site].rate_hz, scenario.sites[peer].rate_hz)
            if age.varies or _has_long_period(link, rate_hz):
                varying.append(age)

        if varying:
            least_ms = 1e3 * min(age.least_s for age in varying)
            most_ms = 1e3 * max(age.most_s for age in varying)
            count = "one link" if len(varying) == 1 else f"{count_nouns(len(varying), 'link')}"
            notes.append(
                f"the age of the samples in use varies on {count}, "
                f"{least_ms:.4g} to {most_ms:.4g} ms: the continuous loop is linearised at the "
                "mean of each, and leaves out the effect of the variation itself"
            )
        if any(site.on_stale.is_active for site in sites):
            notes.append("rules for stale peers are left out: no peer counts as stale")
        return conditions._replace(
            notes=tuple(dict.fromkeys(notes)), varying=bool(varying), links=links
        )


def _describe_laws(scenario: Scenario) -> list[str]:
    """Returns remarks for the user on how the control laws of a scenario are linearised.

    Laws of the user's own code are differentiated numerically, which is less exact than the
    derivatives of the shipped laws. Some shipped laws provide their own remark.

    Args:
        scenario: The experiment.
    """
    notes = []
    sites_by_code: dict[str, list[str]] = {}
    for name, law in scenario.user_laws.items():
        sites_by_code.setdefault(law.code, []).append(name)
    for code, sites in sites_by_code.items():
        notes.append(
            f"{code} of {', '.join(sites)} is differentiated numerically, "
            "and so is its memory: by central differences"
        )
    notes += [law.linear_note for law in scenario.controls if law.linear_note]
    return notes


def _is_constant_link(link: LinkBase) -> bool:
    """Returns True if a network link delays every message equally, and loses none.

    Args:
        link: Delay model of the link, from the scenario.
    """
    return link.constant_delay_ms is not None and not link.loss


def _build_imported_law(scenario: Scenario, site: SiteSetup, alpha: Array) -> SiteSetup:
    """Creates the user's own control law of an arm, so that it can be differentiated.

    Args:
        scenario: The experiment.
        site: Setup of the site.
        alpha: Matrix of dominance factors, shape (N, N).

    Returns:
        The setup with the law. The same setup if the law of the site is not imported.
    """
    law = scenario.user_laws.get(site.name)
    if law is None:
        return site
    i = scenario.names.index(site.name)
    shares = np.delete(alpha[i], i).tolist()
    try:
        return site._replace(law_factory=NumericLaw(site, law.code, shares))
    except ScenarioError as error:
        raise type(error)(error.problem, path=error.path, source=scenario.name) from None


def _find_linear_gains(scenario: Scenario, *, own_laws: bool) -> dict[str, Gains]:
    """Returns the gains with which the control law of each arm acts on small motions.

    Args:
        scenario: The experiment.
        own_laws: True if the code of imported control laws may be executed.
    """
    gains_by_site: dict[str, Gains] = {}
    for name, spec in scenario.sites.items():
        law = spec.control
        theta = scenario.arms[name].theta
        gains = law.linear_gains(theta)
        if own_laws and spec.user_law is not None:
            gains = law.gains(theta)
        if gains is None:
            reason = _explain_missing_gains(scenario, name)
            raise ScenarioError(
                f"has no linear loop: {reason}",
                path=f"sites.{name}.control.law",
                source=scenario.name,
            )
        gains_by_site[name] = gains

    scenario.refuse_external_arms()
    return gains_by_site


def _explain_missing_gains(scenario: Scenario, site: str) -> str:
    """Returns the reason why the control law of an arm cannot be linearised.

    The reason is a part of a sentence.

    Args:
        scenario: The experiment.
        site: Name of the site with the law.
    """
    spec = scenario.sites[site]
    if spec.user_law is not None:
        return (
            f"{spec.law_name} is known by its code only, which may not run here; "
            "trilat linear, trilat certify --law FILE and tn.certify(..., own_laws=True) run it"
        )
    others = (
        "adaptive, adaptive_box, p_d, pd_d, p_f and others have one, "
        f"see {find_page('laws.md')}"
    )
    reason: str = spec.control.explain_no_linear_form() or others
    return reason


def _find_final_link(scenario: Scenario, name: str, notes: list[str]) -> LinkBase:
    """Returns the delay model of a network link that is in force at the end of the run.

    Earlier models do not matter for the stability of the final motion.

    Args:
        scenario: The experiment.
        name: Name of the link, "j->i".
        notes: List to which remarks on earlier models and on outages are added.

    Raises:
        ScenarioError: The delay of the link is measured during the run, and unknown before.
    """
    link = scenario.find_final_link(name)
    if link.measured:
        raise ScenarioError(
            "must not be 'measured', because the delay of a measured link is not known "
            "beforehand: give a model, as in link.model = 'constant'",
            path=f"links.{name}.model",
            source=scenario.name,
        )
    if link != scenario.links[name]:
        notes.append(
            f"link {name} changes during the run: its state at the end is used, "
            f"{link.describe()}"
        )
    if link.outages_s:
        notes.append(f"the outages of link {name} are left out")
    return link


def _has_long_period(link: LinkBase, rate_hz: int) -> bool:
    """Returns True if a link's delay repeats only after more ticks than can be analysed."""
    period_s = link.repetition_s
    return period_s is not None and float(period_s) * rate_hz > MAX_PERIOD_TICKS


def compute_effective_delay(
    scenario: Scenario,
    peer: str,
    site: str,
    link: LinkBase,
) -> _EffectiveDelay:
    """Computes how old a peer's state is when a control loop uses it.

    The ages during the run are used. If the period of the delay is longer than the run, the
    ages during a full period are used instead, because the loop is assumed to continue after
    the run.

    Args:
        scenario: The scenario.
        peer: Name of the sender.
        site: Name of the receiver.
        link: Delay model of the link between them.

    Raises:
        ScenarioError: No sample ever arrives.
    """
    site_hz = scenario.sites[site].rate_hz
    peer_hz = scenario.sites[peer].rate_hz
    model = link.to_core_model()
    is_constant = _is_constant_link(link)
    if is_constant and site_hz == peer_hz:
        delay_us = max(round(model.location), model.playout_us)
        # The negated floor division rounds up to whole ticks.
        whole_ticks = -(-delay_us * site_hz // 1_000_000)
        ticks = max(1, whole_ticks)
        age_s = ticks / site_hz
        return _EffectiveDelay(age_s, age_s, age_s)

    duration_s = scenario.duration_s
    if is_constant:
        # ages repeat, so two seconds beyond the delay contain all of them
        duration_s = min(duration_s, 2.0 + 2e-6 * model.location)
    period_s = link.repetition_s
    if period_s is not None and not _has_long_period(link, max(site_hz, peer_hz)):
        # ages are complete when the samples of a whole period have arrived
        longest_s = 2e-3 * sum(link.moments())
        duration_s = max(duration_s, float(period_s) + longest_s)
    used_samples = link.draw_used_samples(
        key=link_key(scenario.seed, f"{peer}->{site}"),
        receiver_hz=site_hz,
        sender_hz=peer_hz,
        duration_s=duration_s,
    )
    if used_samples[-1] < 0:
        raise ScenarioError(
            "no sample sent over this link ever arrives",
            path=f"links.{peer}->{site}",
            source=scenario.name,
        )

    # ages from the first tick on that uses a sample
    first = int(np.argmax(used_samples >= 0))
    tick_ns = np.arange(first, len(used_samples)) * NS_PER_S // site_hz
    sample_ns = used_samples[first:] * NS_PER_S // peer_hz
    ages_s = (tick_ns - sample_ns) * 1e-9
    return _EffectiveDelay(
        mean_s=float(ages_s.mean()),
        least_s=float(ages_s.min()),
        most_s=float(ages_s.max()),
    )


def has_lasting_delays(scenario: Scenario) -> bool:
    """Returns True if delays that are constant in a run remain constant after its end.

    Delays do not remain constant if a sinusoid or a trace prescribes other delays later. The
    ages of samples are compared, because a play-out buffer may hide varying delays. Random and
    measured delays are ignored, since only records show them.

    Args:
        scenario: The scenario, with the duration of the run.
    """
    for i, j in permutations(range(len(scenario.names)), 2):
        if not scenario.alpha[i, j] and not scenario.timeline:
            continue
        site, peer = scenario.names[i], scenario.names[j]
        link = scenario.find_final_link(f"{peer}->{site}")

        table = link.points
        if link.has_ending_trace and table is not None:
            if table[-1, 0] > 1e6 * scenario.duration_s:
                return False
            continue
        if link.repetition_s is None or link.random:
            continue

        rate_hz = max(scenario.sites[site].rate_hz, scenario.sites[peer].rate_hz)
        age = compute_effective_delay(scenario, peer, site, link)
        if age.varies or _has_long_period(link, rate_hz):
            return False
    return True


def _find_final_dominance(
    scenario: Scenario,
    sites: tuple[SiteSetup, ...],
    notes: list[str],
) -> Array:
    """Returns the dominance factors at the end of the run, as a matrix of shape (N, N).

    A dominance factor is the weight, from 0 to 1, with which one arm follows another.

    Args:
        scenario: The experiment.
        sites: Setups of the sites, with the ramps of their factors.
        notes: List to which remarks on changes are added.
    """
    alpha = scenario.alpha.copy()
    end_ns = round(scenario.duration_s * 1e9)
    for i, site in enumerate(sites):
        peers = [scenario.names.index(link.peer) for link in site.links]
        for ramp in site.ramps:
            if ramp.start_ns > end_ns:
                continue

            progress = 1.0
            if ramp.end_ns > end_ns:
                elapsed_ns = end_ns - ramp.start_ns
                progress = elapsed_ns / (ramp.end_ns - ramp.start_ns)

            remaining_change = np.array(ramp.alpha) - alpha[i, peers]
            alpha[i, peers] += progress * remaining_change
            notes.append(
                f"the dominance factors of {site.name} change during the run: "
                "their values at the end are used"
            )
    return alpha


def _select_final_actors(scenario: Scenario, name: str, notes: list[str]) -> SiteSetup:
    """Returns a site's setup with the operators and environments in force at the end of a run.

    An operator that moves an arm to a target is at the end of its motion, and a scripted torque
    keeps its last value. Chirps and multisines are left out.

    Args:
        scenario: The experiment.
        name: Name of the site.
        notes: List to which a remark on each such change is added.
    """
    setup = scenario.setup(name)
    end_s = scenario.duration_s
    present_actors = [actor for actor in setup.actors if actor.start_s <= end_s < actor.end_s]

    hands = [actor for actor in present_actors if actor.kind in _HANDS]
    if any(hand.move_end_s > end_s for hand in hands):
        notes.append(
            f"an operator at {name} still moves at the end: "
            "the end of that motion is used as the operator's target"
        )
    if any(actor.kind in _PERIODIC for actor in present_actors):
        notes.append(
            f"an operator at {name} still swings at the end: "
            "this torque is left out, because its mean is zero"
        )

    scripted = [
        actor
        for actor in present_actors
        if actor.kind in SCRIPTED_KINDS and actor.kind not in _PERIODIC
    ]
    constant = [actor._replace(a=_evaluate_script(actor, end_s)) for actor in scripted]
    if any(any(actor.a) for actor in constant):
        notes.append(
            f"a scripted torque acts on {name} at the end: its value then is kept constant"
        )

    user_written = [
        actor._replace(move_end_s=end_s) for actor in present_actors if actor.kind in OWN_KINDS
    ]
    special_kinds = (*SCRIPTED_KINDS, *OWN_KINDS, *LIVE_KINDS)
    other_actors = [actor for actor in present_actors if actor.kind not in special_kinds]
    return setup._replace(actors=(*other_actors, *user_written, *constant))


_HANDS = (TorqueKind.HAND, TorqueKind.TASK_HAND)
_PERIODIC = (TorqueKind.CHIRP, TorqueKind.MULTISINE)


def _evaluate_script(actor: TorqueSource, t_s: float) -> tuple[float, ...]:
    """Returns the torque at a given time of an operator that follows a planned signal.

    Args:
        actor: The operator, whose torque is a sin^2 pulse or the interpolation of a table.
        t_s: The time, in s.
    """
    if actor.table is None:
        progress = (t_s - actor.start_s) / (actor.end_s - actor.start_s)
        return tuple(peak * math.sin(math.pi * progress) ** 2 for peak in actor.a)
    times_s, *torques = actor.table.T
    return tuple(
        float(np.interp(t_s, times_s, torque, left=0.0, right=0.0)) for torque in torques
    )
