"""Types of a complete scenario, in which every value is explicit.

Each pair of sites is connected by two directed links. `Scenario.setup` converts a scenario to
the numbers from which the simulation kernel (the compiled control and simulation code) builds a
site.

Invariant:
    - `Scenario.text` is canonical: loading it gives the same scenario. Its SHA-256 hash
      identifies the experiment.
"""

import hashlib
import math
import zlib
from collections.abc import Collection, Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ..core import (
    Array,
    CoreChange,
    DominanceMatrix,
    DominanceRamp,
    Gains,
    LawChannel,
    MotionLimits,
    SiteSetup,
)
from ..errors import ScenarioError, suggest_nearest
from ..fields import Frozen
from ..laws import LawSettings, LawSituation, StabilityCondition
from ..own_code import CodeKey, ImportedLaw, LoggedUserLaw, list_named_code
from ..recorded_change import SiteOrder
from ..records import NS_PER_S, Layout
from .arms import START_MARGIN_RAD, Arm, ArmModel, build_arm, start_margin
from .canonical_text import write_canonical_text
from .change import Change
from .delay_models import Link, LinkBase
from .delay_models.kernel_delays import ConstantDelay
from .distributions import Distribution
from .dominance_rows import resolve_dominance_row
from .expect import Expect
from .laws import ChosenLaw
from .own_plant import OwnPlant
from .site_setups import build_site_setup
from .site_spec import SiteSpec

_POSE_NUMBERS = 7
"""Number of values of the pose of a body: three for the position, four for the quaternion."""
_SLAVE_COLOUR = 2
"""Palette index of the slave's colour."""
_LOOP_GROWS = ", but the roots of the sampled loop grow"
"""Appended to the line about a satisfied condition if the sampled loop is unstable."""
_SAMPLING_BREAKS = ", but sampling breaks it here: the roots of the sampled loop grow"
"""The same, for a condition that proves decay in continuous time."""

ScenarioName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_\-]*\Z", max_length=64)]
Duration = Annotated[float, Meta(gt=0.0, le=86_400.0)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
SchemeName = Literal["second_order", "digital"]


class Scenario(Frozen, frozen=True, dict=True):
    """A complete scenario, in which every value of every site and link is explicit.

    >>> tn.load_scenario("paper").names
    ('m1', 'm2', 's')

    Attributes:
        name: Name of the session and of its log file.
        title: One-line title.
        about: One-paragraph description.
        assumed: Assumptions made where the source of the experiment is silent.
        duration_s: Duration of the run, in s.
        seed: Random seed, which determines every random draw.
        scheme: Integration scheme, "second_order" or "digital" (see `SiteSetup.digital`).
        sites: Ordered mapping from site name to site. The first site leads a live session.
        dominance: Matrix of dominance factors, Eq. (6). The entry in row i and column j is the
            weight of site j in the reference of site i.
        links: Mapping from link name to link, with one link "j->i" for every ordered pair of
            sites.
        timeline: Planned changes during the run.
        expect: Conditions that a run must satisfy (see `trilat test`).
        drawn: Mapping from the dotted key of each drawn number to its distribution.
        urdf: Mapping from file name to content of the URDF files of the arms.
    """

    name: ScenarioName
    duration_s: Duration
    seed: Seed
    scheme: SchemeName
    sites: dict[str, SiteSpec]
    dominance: dict[str, dict[str, float]]
    links: dict[str, Link]
    timeline: tuple[Change, ...] = ()
    expect: Expect = Expect()
    drawn: dict[str, Distribution] = msgspec.field(default_factory=dict)
    urdf: dict[str, str] = msgspec.field(default_factory=dict)
    title: str = ""
    about: str = ""
    assumed: tuple[str, ...] = ()

    def __reduce__(self) -> tuple[Any, ...]:
        """Returns the state for a copy in another process, including the canonical text.

        msgspec omits a default if it is the same object as the default of the class. A copy has
        equal but distinct objects, so its text would contain additional keys.
        """
        return (*super().__reduce__(), {"text": self.text})

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the sites, such as ("m1", "m2", "s"), in the order of the scenario file.

        Arrays with one entry per site use this order.
        """
        return tuple(self.sites)

    @cached_property
    def arms(self) -> dict[str, ArmModel]:
        """Mapping from site name to arm model, with its parameters and geometry.

        Raises:
            ScenarioError: The URDF file of an arm cannot be used.
        """
        chains = any(spec.arm.urdf or spec.task.shared for spec in self.sites.values())
        models = {}
        for name, spec in self.sites.items():
            try:
                model = build_arm(spec.arm, spec.task, self.urdf, chains)
            except ScenarioError as error:
                path = f"sites.{name}.arm"
                if error.path:
                    path = f"{path}.{error.path}"
                raise ScenarioError(error.problem, path=path) from None
            models[name] = model.widen_stops(spec.q0_rad)
        return models

    def group_chains(self) -> list[tuple[Arm, list[str]]]:
        """Returns each distinct arm read from a URDF file, with the sites that use it."""
        groups: list[tuple[Arm, list[str]]] = []
        for name, spec in self.sites.items():
            if not spec.arm.urdf:
                continue
            owners = next((owners for arm, owners in groups if arm == spec.arm), None)
            if owners is None:
                groups.append((spec.arm, [name]))
            else:
                owners.append(name)
        return groups

    def list_arm_notes(self) -> list[str]:
        """Returns sentences about properties of the arms that may surprise a user.

        For example, a joint of the URDF file may be held fixed, or an arm may start beyond a
        position limit, which is then moved for this run. Empty if there are none.
        """
        notes = []
        for arm, owners in self.group_chains():
            subject = f"arm of {', '.join(owners)}"
            notes += [f"{subject}: {note}" for note in arm.read_chain(self.urdf).notes]
        return notes + self.list_start_notes()

    def list_start_notes(self) -> list[str]:
        """Returns sentences about joints that start beyond a stop or a position limit."""
        notes: list[str] = []
        for name, spec in self.sites.items():
            arm = self.arms[name]
            if spec.arm.urdf and spec.arm.stops:
                notes += spec.list_stop_notes(name, arm, self.urdf)
            notes += spec.list_limit_notes(name, arm, self.motion_limits(name))
        return notes

    @cached_property
    def alpha(self) -> Array:
        """Matrix of dominance factors at the start of the run, shape (N, N), Eq. (6).

        The entry in row i and column j is the weight with which arm i follows arm j. It is 0 if
        arm i does not follow arm j.
        """
        return np.array(
            [[self.dominance[i].get(j, 0.0) for j in self.names] for i in self.names]
        )

    @property
    def has_irreversible_shares(self) -> bool:
        """True if the dominance factors are irreversible.

        The dominance factors alpha are reversible if there is a diagonal matrix D > 0 for which
        D (I - alpha) is symmetric, where I is the identity matrix. Some stability conditions
        require this. False if a control law exchanges more than positions or does not
        compensate for gravity, because those conditions do not apply in that case.
        """
        laws = [spec.control for spec in self.sites.values()]
        if not all(law.exchanges_positions() for law in laws):
            return False
        return DominanceMatrix(self.alpha).find_balancing_weights() is None

    @cached_property
    def controls(self) -> tuple[ChosenLaw, ...]:
        """Control law of every arm with its gains, in the order of the sites.

        Gains that a law derives from the initial dominance factors are filled in.
        """
        laws = [spec.control for spec in self.sites.values()]
        return tuple(law.resolve_shares(self.names, self.alpha) for law in laws)

    def law_situations(self) -> Iterator[tuple[str, LawSettings, LawSituation]]:
        """Yields each site with its control law and the quantities that affect stability.

        These quantities include the delays, the rates of the control loops, and the dominance
        factors. If the law has a stability condition, the condition is evaluated from them.
        """
        delay_s = np.zeros((len(self.names), len(self.names)))
        for name, link in self.links.items():
            sender, _, receiver = name.partition("->")
            index = (self.names.index(receiver), self.names.index(sender))
            delay_s[index] = link.find_effective_delay(self.sites[receiver].rate_hz)
        hold_s = self._find_hold_time()
        actors = tuple(site.actors for site in self.sites.values())
        joints = tuple(len(site.q0_rad) for site in self.sites.values())
        for n, (name, site) in enumerate(self.sites.items()):
            situation = LawSituation(
                site=n,
                names=self.names,
                laws=self.controls,
                alpha=self.alpha,
                delay_s=delay_s,
                tau_limit_nm=tuple(np.atleast_1d(site.limits.tau_limit_nm).tolist()),
                rate_hz=site.rate_hz,
                gravity_nm=self.arms[name].largest_gravity(site.arm.g_m_s2),
                hold_s=hold_s,
                actors=actors,
                joints=joints,
                in_task_space=self.layout(name).task,
            )
            yield name, self.controls[n], situation

    @property
    def is_digital(self) -> bool:
        """True if a controller holds the torque of a tick until the next tick."""
        return self.scheme == "digital"

    def _find_hold_time(self) -> float:
        """Returns how long the torque of an arm is held constant, in s.

        This is the control period for the integration scheme "digital", and 0 for other
        schemes. NaN if the control loops have different rates.
        """
        if not self.is_digital:
            return 0.0
        periods_s = {1.0 / site.rate_hz for site in self.sites.values()}
        return periods_s.pop() if len(periods_s) == 1 else math.nan

    def describe_law_conditions(self, *, ticks_grow: bool = False) -> list[str]:
        """Returns one line per stability condition, stating whether it holds.

        Every control law has its own conditions, for example on its gains and on the delays.
        Sites with the same law and the same condition share one line.

        Most conditions are proved for continuous-time controllers. With a controller that acts
        once per tick, the loop may be unstable even if the condition holds.

        Args:
            ticks_grow: True if the discrete-time loop is known to be unstable. The lines about
                satisfied conditions then mention this.
        """
        owners: dict[tuple[str, StabilityCondition], list[str]] = {}
        for name, law, situation in self.law_situations():
            condition = law.condition(situation)
            if condition:
                owners.setdefault((law.tag, condition), []).append(name)
        verdicts = {True: "holds", False: "does not hold", None: "is undecided"}
        lines = []
        for (tag, condition), sites in owners.items():
            verdict = verdicts[condition.holds]
            line = f"condition of {tag} at {', '.join(sites)} {verdict}: {condition.text}"
            if ticks_grow and condition.holds:
                line += _SAMPLING_BREAKS if condition.proves_decay else _LOOP_GROWS
            lines.append(line)
        return lines

    @property
    def beta(self) -> Array | None:
        """Weights of the sites in the energy function of the stability proof, shape (N,).

        The weights beta are positive, sum to 1 and satisfy beta' alpha = beta', where alpha is
        the dominance matrix and the prime denotes the transpose. None if some site does not
        follow some other site, either directly or through other sites, in which case beta is
        not unique.
        """
        matrix = DominanceMatrix(self.alpha)
        return matrix.find_beta() if matrix.is_irreducible else None

    @cached_property
    def text(self) -> str:
        """The scenario as TOML in canonical form.

        Loading the text gives the same scenario. Keys that have no effect are omitted, so they
        do not change the hash of the scenario.
        """
        return write_canonical_text(msgspec.to_builtins(self))

    @cached_property
    def sha256(self) -> str:
        """SHA-256 hash of the canonical TOML form of the scenario (`text`).

        Two scenarios have the same hash only if they describe the same experiment. Sites
        compare hashes before they join a session.
        """
        return hashlib.sha256(self.text.encode()).hexdigest()

    def assign_colours(self, colours: int) -> list[int]:
        """Chooses a colour for each arm in figures.

        The slave is given a fixed colour before all other arms, so it looks the same in all
        figures. The other arms get the first free colours.

        Args:
            colours: Number of colours of the palette.

        Returns:
            A permutation of the colour indices, whose first entries belong to the sites in
            order. Any further entries are unused. If there are more sites than colours, the
            caller repeats the sequence.
        """
        free = list(range(colours))
        assigned = []
        roles = [site.role for site in self.sites.values()]
        for n, role in enumerate(roles[:colours]):
            if role == "slave" and _SLAVE_COLOUR in free:
                colour = _SLAVE_COLOUR
            else:
                is_reserved = "slave" in roles[n:]
                allowed = [
                    index for index in free if not (is_reserved and index == _SLAVE_COLOUR)
                ]
                colour = allowed[0]
            assigned.append(colour)
            free.remove(colour)
        return [*assigned, *free]

    def ticks(self, site: str) -> int:
        """Returns how many ticks a site executes in a complete run.

        Args:
            site: Name of the site.
        """
        return max(1, round(self.duration_s * self.sites[site].rate_hz))

    def peers(self, site: str) -> tuple[str, ...]:
        """Returns the peers of a site: the names of all other sites, in scenario order.

        Includes arms that this one does not follow. Arrays with one entry per peer use this
        order.

        Args:
            site: Name of the site whose peers are returned.
        """
        return tuple(name for name in self.names if name != site)

    def find_site(self, name: str) -> SiteSpec:
        """Returns the site with the given name.

        Args:
            name: Name of the site.

        Raises:
            ScenarioError: There is no such site. The message suggests a similar name.
        """
        if name not in self.sites:
            hint = suggest_nearest(name, self.names)
            # A hint ends the sentence with a question mark.
            listing = " The sites are " if hint else "; the sites are "
            raise ScenarioError(
                f"there is no site {name!r}{hint}" + listing + ", ".join(self.names),
                source=self.name,
            )
        return self.sites[name]

    def scheduled_links(self, name: str) -> Iterator[tuple[int, LinkBase]]:
        """Yields the settings of a link after each planned change.

        Excludes the settings at the start of the run.

        Args:
            name: Name of the link, for example "m1->s".

        Yields:
            Send time of the first affected sample, in ns after the epoch, and the link.
        """
        for change in self.timeline:
            if change.link == name:
                yield change.start_ns, change.after

    def find_final_link(self, name: str) -> LinkBase:
        """Returns the settings of a link in effect at the end of the run.

        Args:
            name: Name of the link, for example "m1->s".
        """
        end_ns = round(self.duration_s * 1e9)
        link: LinkBase = self.links[name]
        for from_ns, later_link in self.scheduled_links(name):
            link = later_link if from_ns <= end_ns else link
        return link

    def _all_links(self) -> list[LinkBase]:
        """Returns the settings of all links, both initially and after planned changes.

        For example, a run is random if any of these settings has random delays.
        """
        later_links = [link for name in self.links for _, link in self.scheduled_links(name)]
        return [*self.links.values(), *later_links]

    @property
    def random(self) -> bool:
        """True if the run depends on the seed.

        Random numbers may be drawn either when the scenario is loaded or during the run.
        """
        return bool(self.drawn) or self.links_random

    @property
    def links_random(self) -> bool:
        """True if a link has random delays, losses or duplicates at any time during the run.

        Includes links that become random through a planned change. Results then depend on the
        seed, and a single run is only an example.
        """
        return any(link.random for link in self._all_links())

    @property
    def measured(self) -> bool:
        """True if at least one link is delayed only by the real network.

        Such a scenario cannot be simulated.
        """
        return any(link.measured for link in self._all_links())

    @property
    def external(self) -> tuple[str, ...]:
        """Names of the sites whose arms are not simulated by the program itself.

        Such an arm is either a real robot or simulated by a user's class.
        """
        return tuple(name for name, spec in self.sites.items() if spec.plant != "simulated")

    @property
    def slave(self) -> str:
        """Name of the slave, the arm that touches the environment.

        The first arm with the role "slave", or the last arm of the scenario if no arm has this
        role.
        """
        slaves = [name for name, spec in self.sites.items() if spec.role == "slave"]
        return slaves[0] if slaves else self.names[-1]

    @property
    def outside(self) -> tuple[str, ...]:
        """Names of the sites whose arms are real robots, with measured motion.

        A simulation cannot run these sites.
        """
        return tuple(name for name, spec in self.sites.items() if spec.plant == "external")

    def check_outside_arms(self) -> None:
        """Raises ScenarioError if a real robot lacks limits or its reference could jump.

        The check is made only before a session, since the scenarios in logs of earlier versions
        may lack these limits.
        """
        for name in self.outside:
            problem = self.sites[name].find_outside_problem(self.arms[name])
            if problem is not None:
                path = f"sites.{name}.{problem.key}"
                raise ScenarioError(problem.problem, path=path, source=self.name)

    @property
    def simulated_settings(self) -> dict[str, Any]:
        """Overrides that make the scenario run with simulated arms only.

        A mapping from dotted key to new value. The overrides also mark the masses of the arms
        as known, and remove dead-man switches, which only real arms have.
        """
        settings: dict[str, Any] = {}
        for name in self.external:
            settings[f"sites.{name}.plant"] = "simulated"
            arm = self.sites[name].arm
            if not arm.known:
                settings[f"sites.{name}.arm.known"] = True
            if arm.dead_man:
                settings[f"sites.{name}.arm.dead_man"] = False
        return settings

    @property
    def simulated_options(self) -> str:
        """Command-line options that run the scenario with simulated arms only.

        Error messages suggest these `--set` options when a scenario with real arms cannot be
        simulated.
        """
        options = []
        for key, value in self.simulated_settings.items():
            text = str(value).lower() if isinstance(value, bool) else value
            options.append(f"--set {key}={text}")
        return " ".join(options)

    def refuse_external_arms(self, exempt: Collection[str] = ()) -> None:
        """Raises ScenarioError if the program does not simulate all arms itself.

        An external arm is either a real robot or simulated by a user's class.

        Args:
            exempt: Names of sites whose arms may be external because their motion is read from
                a log.

        Raises:
            ScenarioError: The arm of another site is external.
        """
        options = self.simulated_options
        for name in self.external:
            if name in exempt:
                continue
            problem = (
                "is a user's own plant, which runs in `trilat sim` and live, but not here; to "
                f"use the arm of the scenario instead, add: {options}"
            )
            if name in self.outside:
                problem = (
                    "is external: a scenario with an external arm can only run live; to "
                    f"rehearse it with a simulated arm, add: {options}"
                )
            raise ScenarioError(problem, path=f"sites.{name}.plant", source=self.name)

    def refuse_live_only(self) -> None:
        """Raises ScenarioError if the scenario can only be run as a live session.

        Raises:
            ScenarioError: An arm is external, or a link has the model "measured", whose delay
                is that of the real network. A simulation has no real network.
        """
        self.refuse_external_arms()
        if not self.measured:
            return
        measured_links = [name for name, link in self.links.items() if link.measured]
        path = f"links.{measured_links[0]}.model" if measured_links else "timeline"
        raise ScenarioError(
            "is 'measured', the delay of a real network: a scenario with such a link can only "
            "run live; to run the scenario here, set another model, as in link.model=constant "
            "and link.delay_ms=50",
            path=path,
            source=self.name,
        )

    @property
    def imported_code(self) -> list[tuple[str, str]]:
        """Users' Python classes that the scenario uses: laws, operators and plants.

        Each item is the name of a class, such as "mylaws:Spring", and the SHA-256 hash of its
        file.
        """
        named = [(code.code, code.source_sha256) for code in list_named_code(self)]
        return list(dict.fromkeys(named))

    @cached_property
    def user_laws(self) -> dict[str, ImportedLaw]:
        """Mapping from site name to control law, for laws that are users' Python classes.

        Empty if all laws are built in.
        """
        laws = {name: spec.user_law for name, spec in self.sites.items()}
        return {name: law for name, law in laws.items() if law is not None}

    def inspect_user_laws(self) -> list[LoggedUserLaw]:
        """Describes the control laws that are users' classes, without running their code.

        Each entry states whether the law may run and which file would be used. Files and
        permissions are read again on each call.
        """
        sites: dict[CodeKey, list[str]] = {}
        for name, law in self.user_laws.items():
            sites.setdefault(CodeKey.of(law), []).append(name)
        return [
            LoggedUserLaw.inspect(self.user_laws[names[0]], tuple(names))
            for names in sites.values()
        ]

    @property
    def open_hands(self) -> tuple[str, ...]:
        """Names of the sites whose arms any member of the session may move.

        A member is a process that takes part in the session, such as the live web page or the
        ROS 2 bridge. Arms operated by a user's program are excluded, since only that program
        moves them.
        """
        return tuple(
            name
            for name, spec in self.sites.items()
            if spec.find_live_hand(is_open=True) is not None
        )

    @property
    def sites_may_return(self) -> bool:
        """True if a site may leave a live session and return to it.

        Every site must have the reaction "glide" to missing samples (see `OnStale`). The other
        arms then come to rest, and later follow the returning arm smoothly.
        """
        return all(spec.on_stale.action == "glide" for spec in self.sites.values())

    def draw_seed(self, site: str) -> int:
        """Returns the random seed for user code at one site.

        Derived from the seed of the scenario and the name of the site, so sites with the same
        code draw different numbers.

        Args:
            site: Name of the site.
        """
        return zlib.crc32(f"{self.seed}/{site}".encode())

    def channel(self, site: str) -> LawChannel:
        """Returns the additional vectors that the control law of a site sends to its peers.

        Most laws send nothing but the state of the arm. A law that also sends wave variables,
        for example, has a vector for them.

        Args:
            site: Name of the site.
        """
        layout = SiteSetup.make_layout(self.arms[site].chain)
        return self.sites[site].control.build_channel(layout, len(self.names) - 1)

    def layout(self, site: str) -> Layout:
        """Returns the lengths of all vectors in the log of a site.

        Each record of the log contains vectors such as joint angles and torques.

        Args:
            site: Name of the site.
        """
        live_hand = self.sites[site].find_live_hand()
        actors = () if live_hand is None else (live_hand.actor,)
        layout = SiteSetup.make_layout(
            self.arms[site].chain, self.channel(site).record_size, actors
        )
        return layout._replace(bodies=_POSE_NUMBERS * len(self.bodies_m(site)))

    def bodies_m(self, site: str) -> dict[str, tuple[float, float, float]]:
        """Returns the sizes of the bodies that a plant moves in addition to the arm, in m.

        For example, the arm may push a box.

        Args:
            site: Name of the site.

        Returns:
            Mapping from body name to its extents along its own axes x, y and z, in m. Empty if
            there are none.
        """
        plant = self.sites[site].plant
        return plant.bodies if isinstance(plant, OwnPlant) else {}

    def setup(self, site: str) -> SiteSetup:
        """Returns the settings from which the compiled control loop of a site is built.

        They include the arm, control law, network links and limits of the site. The result is
        cached, since both the validation of a scenario and the run need it.

        Args:
            site: Name of the site.
        """
        if site not in self._setups:
            self._setups[site] = build_site_setup(self, site)
        return self._setups[site]

    @cached_property
    def _setups(self) -> dict[str, SiteSetup]:
        """Cache of `setup`: mapping from site name to result."""
        return {}

    def motion_limits(self, site: str) -> MotionLimits:
        """Returns the limits on the motion of an arm during a run.

        A joint may start beyond `q_min_rad` or `q_max_rad` by up to a small margin. In that
        case, the limit on that side is moved outward by the margin for the entire run, so that
        the arm does not stop immediately.

        Args:
            site: Name of the site.
        """
        spec = self.sites[site]
        arm = self.arms[site]
        motion = spec.limits.motion
        start = np.array(spec.q0_rad)
        if not np.any((start < motion.q_min) | (start > motion.q_max)):
            return motion
        low = np.broadcast_to(motion.q_min, start.shape)
        high = np.broadcast_to(motion.q_max, start.shape)
        margin = np.full(start.shape, START_MARGIN_RAD)
        if arm.chain is not None:
            margin = np.array([start_margin(joint) for joint in arm.chain.joints])
        starts_below = (start < low) & (start >= low - margin)
        starts_above = (start > high) & (start <= high + margin)
        return motion._replace(
            q_min=tuple(np.where(starts_below, low - margin, low).tolist()),
            q_max=tuple(np.where(starts_above, high + margin, high).tolist()),
        )

    def gains(self, site: str) -> Gains:
        """Returns the gains of a site's control law, in the form read by the control loop.

        If the law is adaptive and the site can stop smoothly (`on_stale.action` is "glide"),
        the result includes bounds on the estimated parameters.

        Args:
            site: Name of the site.
        """
        spec = self.sites[site]
        arm = self.arms[site]
        gains = spec.control.gains(arm.theta)
        if spec.on_stale.action != "glide":
            return gains
        return arm.bound_estimates(gains, spec.limits.tau_limit_nm, spec.arm.g_m_s2)

    def ramp(
        self, site: str, shares: dict[str, float], start_ns: int, ramp_s: float
    ) -> DominanceRamp:
        """Returns a gradual change of dominance factors, in the form read by the control loop.

        Args:
            site: Name of the site whose dominance factors change.
            shares: Mapping from peer name to the factor after the change; missing peers get 0.
            start_ns: Start of the change, in ns after the common start time of all sites.
            ramp_s: Duration of the linear transition, in s.
        """
        alpha = tuple(shares.get(peer, 0.0) for peer in self.peers(site))
        return DominanceRamp(start_ns, start_ns + round(ramp_s * 1e9), alpha)

    def scripted_ramps(self, site: str) -> list[DominanceRamp]:
        """Returns the planned changes of a site's dominance factors.

        Args:
            site: Name of the site.

        Returns:
            The changes in the form read by the control loop. Empty if none are planned.
        """
        return [
            self.ramp(site, change.to, change.start_ns, change.ramp_s)
            for change in self.timeline
            if change.dominance == site
        ]

    def make_site_order(
        self, site: str, order: SiteOrder, from_ns: int, ticks: int = 0
    ) -> Change:
        """Returns a command for a site, such as "stop", in the form of a `Change`.

        The command can then be sent and logged like a change of a link.

        Args:
            site: Name of the site that must carry out the command.
            order: The command, for example "stop".
            from_ns: Time of the control period in which the command is carried out, in ns after
                the common start time of all sites.
            ticks: Number of control periods that the site missed, for the command "overrun".

        Raises:
            ScenarioError: The site cannot stop and resume smoothly, because `on_stale.action`
                is not "glide".
        """
        action = self.sites[site].on_stale.action
        if action != "glide":
            raise ScenarioError(
                f"{site} has on_stale.action = {action!r}, but only a site with 'glide' can "
                "stop and go on without a jump; to end the whole session, use trilat stop --end"
            )
        return Change(at_s=from_ns / NS_PER_S, site=site, order=order, ticks=ticks)

    def to_core_change(self, change: Change) -> CoreChange:
        """Converts a change to the form read by the compiled control loop.

        Args:
            change: Change of a link or of a site's dominance factors, or a command to a site.
        """
        text = msgspec.json.encode(change).decode()
        site = change.owner
        if change.order:
            return CoreChange.give_order(text, change.order, change.ticks)
        if change.dominance:
            ramp = self.ramp(site, change.to, change.start_ns, change.ramp_s)
            return CoreChange(text, ramp=ramp)
        sender = change.link.partition("->")[0]
        return CoreChange(
            text,
            peer=self.peers(site).index(sender),
            model=change.after.to_core_model(change.start_ns),
        )

    def parse_core_change(self, site: str, text: str) -> CoreChange:
        """Parses a logged change into the record that the compiled control loop reads.

        The log may come from an untrusted source, so the change is validated completely.

        Args:
            site: Name of the site that published the record.
            text: The change as JSON, as stored in the record.

        Raises:
            ScenarioError: The text is not a valid change, or the change belongs to another
                site.
        """
        try:
            change = msgspec.json.decode(text, type=Change)
        except (msgspec.DecodeError, msgspec.ValidationError) as error:
            raise ScenarioError(
                f"the record contains a command that cannot be read: {error}", path=text[:80]
            ) from None
        sites = ("", *self.names)
        if (
            change.link not in ("", *self.links)
            or change.dominance not in sites
            or change.site not in sites
        ):
            raise ScenarioError(
                "the record contains a command for a link or site that does not exist",
                path=text[:80],
            )

        targets = [name for name in (change.link, change.dominance, change.site) if name]
        is_order = bool(change.order)
        is_for_site = change.owner == site
        if not is_for_site or len(targets) != 1 or bool(change.site) != is_order:
            raise ScenarioError(
                f"the record contains a command that is not for {site}", path=text[:80]
            )

        if is_order:
            # called only to check the change
            self.make_site_order(site, change.order, change.start_ns)
        change.check_link("cmd")
        if change.dominance:
            resolve_dominance_row(change.to, list(self.names), change.dominance, "cmd.to")
        return self.to_core_change(change)

    def with_constant_delays(self, delays_ms: Mapping[str, float]) -> "Scenario":
        """Returns a copy of the scenario with constant delays on some links.

        Planned changes of these links are dropped.

        Args:
            delays_ms: Mapping from link name to delay in ms.
        """
        links = {name: ConstantDelay(delay_ms=delay_ms) for name, delay_ms in delays_ms.items()}
        timeline = tuple(change for change in self.timeline if change.link not in delays_ms)
        return msgspec.structs.replace(self, links={**self.links, **links}, timeline=timeline)

    def without_hands(self) -> "Scenario":
        """Returns a copy of the scenario with no operators.

        Walls and other environments are kept. Values drawn at random for operators are removed
        from `drawn`.
        """
        sites = {
            name: msgspec.structs.replace(spec, hands=()) for name, spec in self.sites.items()
        }
        drawn = {key: origin for key, origin in self.drawn.items() if ".hands." not in key}
        return msgspec.structs.replace(self, sites=sites, drawn=drawn)
