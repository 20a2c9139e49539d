"""The types of a complete scenario: sites, changes and the core's setup of a site.

Invariant:
    - Keys end in their unit; symbols are the paper's.
    - `Scenario.text` is canonical: it loads to the same scenario, and its SHA-256 names the
      experiment.
    - A change names the time from which it holds, and is complete in itself.
"""

import hashlib
import math
import re
import zlib
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import tomli_w
from msgspec import Meta

from ..core import dominance, site_setup
from ..core.chain import MAX_JOINTS
from ..core.law_channel import LawChannel
from ..core.philox import link_key
from ..core.ticks import DominanceRamp
from ..core.two_link_arm import ArmLinks
from ..core.vectors import Array
from ..errors import ScenarioError
from ..fields import Frozen, Joints, Positive, PositiveJoints, RateHz, Real
from ..laws.sent_vectors import SentVectorSpecs, build_channel
from .arms import (
    START_MARGIN_RAD,
    Arm,
    ArmModel,
    Task,
    bound_estimates,
    build_arm,
    compute_rest_gains,
    start_margin,
)
from .delay_models import Link, LinkBase
from .distributions import Distribution
from .expect import Expect
from .laws import ChosenLaw
from .operators import Environment, Operator
from .operators.kernel_operators import LiveHand
from .own_plant import OwnPlant


class OnStale(Frozen, frozen=True, omit_defaults=True):
    """The rule for a peer whose sample in use is too old, or who is silent.

    Attributes:
        action: "use": the site goes on with the sample; "hold": it stays at the last reference;
            "brake": it stays where the arm is; "glide": at the start it waits for all peers,
            it lets its reference come to rest if no sample of a peer came into use for a time,
            and it aligns with its peers without a jump.
        age_ms: age of a sample beyond which it is too old, ms; not for "glide".
        return_s: duration of the return once a fresh sample is in use, s; not for "glide".
        silence_ms: for "glide", the time without a new sample in use after which a peer is
            silent, ms.
        align_speed_rad_s: for "glide", the speed with which the site goes to its peers, rad/s;
            m/s for a position.
        align_limit_rad: for "glide", the longest way that the site goes by itself, rad; m for a
            position.
        on_lost: for "glide", "hold": the site holds while a peer is silent; "degrade": it goes
            on without a silent master, as long as the others reach each other.
    """

    action: Literal["use", "hold", "brake", "glide"] = "use"
    age_ms: Annotated[float, Meta(gt=0.0, le=1e6)] = 350.0
    return_s: Annotated[float, Meta(gt=0.0, le=1e3)] = 1.0
    silence_ms: Annotated[float, Meta(gt=0.0, le=1e4)] = 20.0
    align_speed_rad_s: Annotated[float, Meta(gt=0.0, le=1e3)] = 0.5
    align_limit_rad: Annotated[float, Meta(gt=0.0, le=1e3)] = 1.0
    on_lost: Literal["hold", "degrade"] = "hold"

    @property
    def rule(self) -> site_setup.StaleRule:
        """The rule in the form of the core."""
        if self.action == "glide":
            return site_setup.StaleRule(
                action=site_setup.StaleAction.GLIDE,
                age_ns=round(self.silence_ms * 1e6),
                align_speed=self.align_speed_rad_s,
                align_limit=self.align_limit_rad,
                degrades=self.on_lost == "degrade",
            )
        return site_setup.StaleRule(
            action=site_setup.StaleAction[self.action.upper()],
            age_ns=round(self.age_ms * 1e6),
            return_ns=round(self.return_s * 1e9),
        )


SpeedLimit = Annotated[float, Meta(gt=0.0, le=10_000.0)]
SpeedLimits = Annotated[tuple[SpeedLimit, ...], Meta(min_length=1, max_length=MAX_JOINTS)]


GLIDE_TAU_RATE_NM_S = 1000.0
"""Default limit of the torque's rate of change under the rule "glide".

1 N m per millisecond is what Franka's arms ask for.
"""


def _or_infinity(limit: Any) -> Any:
    return math.inf if limit is None else limit


class Limits(Frozen, frozen=True):
    """The limits of a site. A limit is one number, or one number per joint.

    Attributes:
        tau_limit_nm: largest control torque of a joint, N m; a larger torque is cut off. Left
            out: the efforts that the file of a chain states.
        qd_limit_rad_s: joint speed beyond which a run counts as diverged and ends, rad/s. Under
            the rule "glide" the site is in fault instead, and the run goes on. Left out: the
            speeds that the file of a chain states.
        tau_rate_limit_nm_s: largest rate of change of the control torque of a joint, N m/s.
            Left out: no limit, but `GLIDE_TAU_RATE_NM_S` under the rule "glide".
        qd_des_limit_rad_s: largest speed of the reference, rad/s; m/s for a position.
        q_min_rad: least angle of a joint, rad; only with the rule "glide": beyond it the site
            is in fault.
        q_max_rad: largest angle of a joint, rad, likewise.
    """

    tau_limit_nm: Positive | PositiveJoints = 200.0
    qd_limit_rad_s: SpeedLimit | SpeedLimits = 100.0
    tau_rate_limit_nm_s: Positive | PositiveJoints | None = None
    qd_des_limit_rad_s: SpeedLimit | SpeedLimits | None = None
    q_min_rad: Real | Joints | None = None
    q_max_rad: Real | Joints | None = None

    @property
    def motion(self) -> site_setup.MotionLimits:
        """The limits of the motion in the form of the core; infinite if left out."""
        return site_setup.MotionLimits(
            q_min=-math.inf if self.q_min_rad is None else self.q_min_rad,
            q_max=_or_infinity(self.q_max_rad),
            qd_des_limit=_or_infinity(self.qd_des_limit_rad_s),
            tau_rate=_or_infinity(self.tau_rate_limit_nm_s),
        )


class SiteSpec(Frozen, frozen=True):
    """A site: an arm with its control loop.

    Attributes:
        role: the role of the site for a reader of figures; it enters no formula.
        rate_hz: tick rate of the loop, Hz.
        q0_rad: start pose, rad.
        qd0_rad_s: start velocity, rad/s.
        arm: the arm.
        control: the control law and its gains.
        limits: the limits of torques, speeds and positions.
        on_stale: the rule for a peer whose samples are too old.
        task: the coordinates that the site follows: joint angles, or those of the end effector.
        hands: the operators who act on the arm.
        environment: the walls and other bodies that act on the arm.
        plant: "simulated"; "external": an arm outside of the program, whose state is measured;
            or a user's class that moves the arm.
        view: delay, loss and order of the picture in which the site's user sees its peers, as
            for a link; None: the user sees the samples in use. It enters no formula.
    """

    role: Literal["master", "slave"]
    rate_hz: RateHz
    q0_rad: Joints
    qd0_rad_s: Joints
    arm: Arm
    control: ChosenLaw
    limits: Limits
    on_stale: OnStale = OnStale()
    task: Task = Task()
    hands: tuple[Operator, ...] = ()
    environment: tuple[Environment, ...] = ()
    plant: Literal["simulated", "external"] | OwnPlant = "simulated"
    view: Link | None = None

    def find_live_hand(self, *, is_open: bool = False) -> LiveHand | None:
        """Returns the hand that acts while the session runs, or None.

        Args:
            is_open: true: only a hand that anybody in the session may hold.
        """
        for hand in self.hands:
            if isinstance(hand, LiveHand) and (hand.is_open or not is_open):
                return hand
        return None


SITE_GROUPS: dict[str, type[Frozen]] = {
    "arm": Arm,
    "limits": Limits,
    "on_stale": OnStale,
    "task": Task,
}
"""Tables that a scenario may have for all sites, and each site for itself, with their types."""


SiteOrder = Literal[
    "",
    "stop",
    "enable",
    "reset",
    "overrun",
    "arm_silent",
    "arm_lost",
    "arm_back",
    "released",
    "held",
]
"""Orders to a site; "": none.

Stop, enable and reset come from outside; the site gives the others to itself.
"""
TIMELINE_KEYS = ("at_s", "link", "dominance", "to", "ramp_s")
"""Keys of a change on the timeline of a scenario."""


class Change(Frozen, frozen=True, omit_defaults=True):
    """A change of a link or of dominance factors, or an order to a site.

    Exactly one of `link`, `dominance` and `site` is given. Only records have `site`.

    Attributes:
        at_s: when the change takes effect, s after the epoch; for a link, the stamp from which
            samples are affected.
        link: the link that changes, as in "m1->s".
        dominance: the site whose dominance factors change.
        to: the whole link after the change, or all factors of the row.
        ramp_s: duration of the linear change of the factors, s.
        site: the site that gets an order.
        order: the order, see `core.ticks.LifeOrder`.
        ticks: for "overrun", how many ticks the site missed.
    """

    at_s: Annotated[float, Meta(ge=0.0, le=1e6)]
    link: str = ""
    dominance: str = ""
    to: dict[str, Any] = msgspec.field(default_factory=dict)
    ramp_s: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    site: str = ""
    order: SiteOrder = ""
    ticks: Annotated[int, Meta(ge=0, lt=2**40)] = 0

    @property
    def start_ns(self) -> int:
        """When the change takes effect, ns since the epoch."""
        return round(self.at_s * 1e9)

    @property
    def after(self) -> LinkBase:
        """The link after the change."""
        return msgspec.convert(self.to, Link)


def scheduled_links(timeline: Sequence[Change], name: str) -> Iterator[tuple[int, LinkBase]]:
    """Yields the later states of a link in order, each with its first stamp, ns."""
    for change in timeline:
        if change.link == name:
            yield change.start_ns, change.after


_ABSENT_VALUES: dict[str, tuple[Any, ...]] = {
    **dict.fromkeys(("timeline", "environment"), ((), [])),
    **dict.fromkeys(("expect", "drawn", "urdf", "on_stale", "task", "sends"), ({},)),
    "plant": ("simulated",),
    **dict.fromkeys(
        ("tau_rate_limit_nm_s", "qd_des_limit_rad_s", "q_min_rad", "q_max_rad", "view"), (None,)
    ),
}
"""Keys that older scenarios lack, with the values that have no effect.

These values are left out of the text, so that the text of an older scenario stays the same.
"""
_POSE_NUMBERS = 7
"""Numbers of the pose of a body: a position and a quaternion."""
_SLAVE_COLOUR = 2
"""Index of the slave's colour in a palette."""
_NUMBER_LIST = re.compile(r"\[\n(?:    [-+.\de]+,\n)+\]")
"""A list of numbers that is written one number per line."""


def _drop_unused_keys(arm: dict[str, Any]) -> None:
    """Removes from an arm's table the keys of other kinds of arms, and defaults of a chain."""
    defaults = msgspec.to_builtins(Arm())
    is_chain = bool(arm["urdf"])
    unused_keys = ArmLinks._fields if is_chain else ()
    kept_keys = () if is_chain else (*ArmLinks._fields, "g_m_s2")
    for key, value in list(arm.items()):
        if key in unused_keys or (key not in kept_keys and value == defaults[key]):
            del arm[key]


def _drop_absent_values(table: dict[str, Any]) -> None:
    """Removes from a table the values that mean the same as their absence."""
    for key, absent_values in _ABSENT_VALUES.items():
        if key in table and table[key] in absent_values:
            del table[key]


def _join_number_list(match: re.Match[str]) -> str:
    """Returns a list of numbers in one line."""
    return " ".join(match[0].split()).replace("[ ", "[").replace(", ]", "]")


class Scenario(Frozen, frozen=True, dict=True):
    """An experiment, resolved: every value of every site and link is explicit.

    >>> tn.load_scenario("paper").names
    ('m1', 'm2', 's')

    Attributes:
        name: the name of the session and the log.
        title: one line for people.
        about: a paragraph for people.
        assumed: assumptions that the source of the experiment does not state.
        duration_s: its duration, s.
        seed: the seed; every random draw is a function of it.
        scheme: "second_order" or "digital", see `Scheme`.
        sites: the sites, in order; the first leads a live session.
        dominance: row i, column j: factor of site j in the reference of site i, Eq. (6).
        links: "j->i" for every pair of sites.
        timeline: changes during the run.
        expect: expectations, see `trilat test`.
        drawn: the distributions that numbers of the sites were drawn from, by dotted key.
        urdf: the texts of the files that describe arms, by their names.
    """

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_\-]*\Z", max_length=64)]
    duration_s: Annotated[float, Meta(gt=0.0, le=86_400.0)]
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)]
    scheme: Literal["second_order", "digital"]
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
        """Returns the state for a copy in another process, with the text.

        Defaults are left out of the text by their identity, which a copy does not keep.
        """
        return (*super().__reduce__(), {"text": self.text})

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the sites, in order."""
        return tuple(self.sites)

    @cached_property
    def arms(self) -> dict[str, ArmModel]:
        """The model of each site's arm.

        Raises:
            ScenarioError: an arm's file cannot be used.
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

    @cached_property
    def alpha(self) -> Array:
        """The dominance matrix, shape (N, N), Eq. (6)."""
        return np.array(
            [[self.dominance[i].get(j, 0.0) for j in self.names] for i in self.names]
        )

    @cached_property
    def controls(self) -> tuple[ChosenLaw, ...]:
        """The law of every site, with the gains that follow from the shares at the start."""
        laws = [spec.control for spec in self.sites.values()]
        return tuple(law.resolve_shares(self.names, self.alpha) for law in laws)

    @property
    def beta(self) -> Array | None:
        """Left null vector of Upsilon, shape (N,), sum 1, Eq. (20).

        None if alpha is reducible.
        """
        if not dominance.is_irreducible(self.alpha):
            return None
        return dominance.perron_vector(self.alpha)

    @cached_property
    def text(self) -> str:
        """The canonical TOML text."""
        tables: dict[str, Any] = msgspec.to_builtins(self)
        descriptions = {key: tables.pop(key) for key in ("name", "title", "about", "assumed")}
        descriptions = {key: value for key, value in descriptions.items() if value}
        for site in tables["sites"].values():
            _drop_unused_keys(site["arm"])
        _drop_absent_values(tables)
        for site in tables["sites"].values():
            _drop_absent_values(site)
            _drop_absent_values(site["control"])
            _drop_absent_values(site["limits"])
        urdf_texts = tables.pop("urdf", None)
        numbers = _NUMBER_LIST.sub(_join_number_list, tomli_w.dumps(tables))
        files = ""
        if urdf_texts:
            files = tomli_w.dumps({"urdf": urdf_texts}, multiline_strings=True)
        return tomli_w.dumps(descriptions, multiline_strings=True) + numbers + files

    @cached_property
    def sha256(self) -> str:
        """The hash of the canonical text, which names the experiment."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def assign_colours(self, colours: int) -> list[int]:
        """Returns the index of a colour for each site, then those of the unused colours.

        A slave gets the slave's colour. Sites beyond the number of colours begin anew.

        Args:
            colours: the number of colours of the palette.
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
        """Returns the number of ticks of a site."""
        return max(1, round(self.duration_s * self.sites[site].rate_hz))

    def peers(self, site: str) -> tuple[str, ...]:
        """Returns the peers of a site, in scenario order."""
        return tuple(name for name in self.names if name != site)

    def _all_links(self) -> list[LinkBase]:
        """Returns the links at the start and all their later states."""
        later_links = [
            link for name in self.links for _, link in scheduled_links(self.timeline, name)
        ]
        return [*self.links.values(), *later_links]

    @property
    def random(self) -> bool:
        """True if any number is drawn: another seed is then another run."""
        return bool(self.drawn) or self.links_random

    @property
    def links_random(self) -> bool:
        """True if some link draws its delays or losses during the run."""
        return any(link.random for link in self._all_links())

    @property
    def measured(self) -> bool:
        """True if some link injects no delay, so that the real network decides."""
        return any(link.measured for link in self._all_links())

    @property
    def external(self) -> tuple[str, ...]:
        """The sites whose arms are measured: outside of the program, or users' plants."""
        return tuple(name for name, spec in self.sites.items() if spec.plant != "simulated")

    @property
    def slave(self) -> str:
        """The first site whose role is slave, else the last site."""
        slaves = [name for name, spec in self.sites.items() if spec.role == "slave"]
        return slaves[0] if slaves else self.names[-1]

    @property
    def outside(self) -> tuple[str, ...]:
        """The sites whose arms are outside of the program."""
        return tuple(name for name, spec in self.sites.items() if spec.plant == "external")

    @property
    def open_hands(self) -> tuple[str, ...]:
        """The sites whose arms anybody in the session may hold."""
        return tuple(
            name
            for name, spec in self.sites.items()
            if spec.find_live_hand(is_open=True) is not None
        )

    @property
    def sites_may_return(self) -> bool:
        """True if a session outlives its sites.

        Each site then waits for its peers and aligns with them again.
        """
        return all(spec.on_stale.action == "glide" for spec in self.sites.values())

    def draw_seed(self, site: str) -> int:
        """Returns the seed for the random numbers of users' code at a site."""
        return zlib.crc32(f"{self.seed}/{site}".encode())

    def channel(self, site: str) -> LawChannel:
        """Returns the vectors that the law of a site sends to its peers."""
        sends: SentVectorSpecs = getattr(self.sites[site].control, "sends", {})
        layout = site_setup.Layout.of_arm(self.arms[site].chain)
        return build_channel(sends, layout, len(self.names) - 1)

    def layout(self, site: str) -> site_setup.Layout:
        """Returns the lengths of a site's vectors."""
        live_hand = self.sites[site].find_live_hand()
        actors = () if live_hand is None else (live_hand.actor,)
        layout = site_setup.Layout.of_arm(
            self.arms[site].chain, self.channel(site).record_size, actors
        )
        return layout._replace(bodies=_POSE_NUMBERS * len(self.bodies_m(site)))

    def bodies_m(self, site: str) -> dict[str, tuple[float, float, float]]:
        """Returns the bodies that a site's plant moves besides its arm.

        Returns:
            The sizes of each body along its own axes, m, by name.
        """
        plant = self.sites[site].plant
        return plant.bodies if isinstance(plant, OwnPlant) else {}

    def setup(self, site: str) -> site_setup.SiteSetup:
        """Returns the setup from which the core builds a site."""
        spec = self.sites[site]
        arm = self.arms[site]
        index = self.names.index(site)
        control = self.controls[index]
        rest_gains = site_setup.RestGains()
        if spec.on_stale.action == "glide":
            rest_gains = self._rest_gains(site)
        return site_setup.SiteSetup(
            name=site,
            rate_hz=spec.rate_hz,
            scheme=site_setup.Scheme[self.scheme.upper()],
            gains=self.gains(site),
            theta=arm.theta,
            g_m_s2=spec.arm.g_m_s2,
            lengths_m=arm.lengths_m,
            tau_limit_nm=spec.limits.tau_limit_nm,
            qd_limit_rad_s=spec.limits.qd_limit_rad_s,
            q0=spec.q0_rad,
            qd0=spec.qd0_rad_s,
            actors=tuple(actor.actor for actor in (*spec.hands, *spec.environment)),
            links=tuple(self._link_setup(peer, site) for peer in self.peers(site)),
            ramps=tuple(self.scripted_ramps(site)),
            on_stale=spec.on_stale.rule,
            external=spec.plant != "simulated",
            law_factory=control.build_factory(len(self.sites), self.scheme),
            theta_known=spec.arm.known,
            chain=arm.chain,
            channel=self.channel(site),
            bodies=len(self.bodies_m(site)),
            limits=self.motion_limits(site),
            rest=rest_gains,
            bit=1 << index,
        )

    def motion_limits(self, site: str) -> site_setup.MotionLimits:
        """Returns the limits of a site's motion, with room for its start pose.

        A joint that starts beyond `q_min_rad` or `q_max_rad` by no more than the margin may be
        there during the whole run: its limit on that side lies the margin farther out.
        """
        spec = self.sites[site]
        arm = self.arms[site]
        motion = spec.limits.motion
        start = np.array(spec.q0_rad)
        low = np.broadcast_to(motion.q_min, start.shape)
        high = np.broadcast_to(motion.q_max, start.shape)
        if not np.any((start < low) | (start > high)):
            return motion
        margin = np.full(start.shape, START_MARGIN_RAD)
        if arm.chain is not None:
            margin = np.array([start_margin(joint) for joint in arm.chain.joints])
        starts_below = (start < low) & (start >= low - margin)
        starts_above = (start > high) & (start <= high + margin)
        return motion._replace(
            q_min=tuple(np.where(starts_below, low - margin, low).tolist()),
            q_max=tuple(np.where(starts_above, high + margin, high).tolist()),
        )

    def gains(self, site: str) -> site_setup.Gains:
        """Returns the gains of a site's law; under the rule `glide` with a box of estimates."""
        spec = self.sites[site]
        arm = self.arms[site]
        gains = spec.control.gains(arm.theta)
        if spec.on_stale.action != "glide":
            return gains
        return bound_estimates(gains, arm, spec.limits.tau_limit_nm, spec.arm.g_m_s2)

    def _rest_gains(self, site: str) -> site_setup.RestGains:
        """Returns the gains with which a site's arm comes to rest."""
        spec = self.sites[site]
        arm = self.arms[site]
        gains = spec.control.linear_gains(arm.theta) or spec.control.gains(arm.theta)
        law_damping: Array = np.zeros(arm.counts.joints) + gains.Kp + gains.d
        return compute_rest_gains(
            arm=arm,
            q0=spec.q0_rad,
            law_damping=law_damping,
            limit_nm=spec.limits.tau_limit_nm,
            rate_hz=spec.rate_hz,
            known=spec.arm.known,
        )

    def _link_setup(self, peer: str, site: str) -> site_setup.LinkSetup:
        """Returns the setup of the link from a peer to a site."""
        name = f"{peer}->{site}"
        first_link = self.links[name]
        later_links = scheduled_links(self.timeline, name)
        links: list[tuple[int, LinkBase]] = [(0, first_link), *later_links]
        peer_index = self.names.index(peer)
        speed_limit: tuple[float, ...] = ()
        if self.sites[site].on_stale.action == "glide":
            speed_limit = self._speed_limit(peer)
        return site_setup.LinkSetup(
            peer=peer,
            alpha=self.dominance[site].get(peer, 0.0),
            rate_hz=self.sites[peer].rate_hz,
            q0=self.arms[peer].shared_pose(self.sites[peer].q0_rad),
            key=link_key(self.seed, name),
            models=tuple(link.to_core_model(from_ns) for from_ns, link in links),
            traces=tuple(link.points for _, link in links),
            outages=tuple(
                (round(start_s * 1e9), round(end_s * 1e9))
                for start_s, end_s in first_link.outages_s
            ),
            channel=self.channel(peer),
            index_at_peer=self.peers(peer).index(site),
            speed_limit=speed_limit,
            bit=1 << peer_index,
            followed=self._followed_sites(peer_index),
            dispensable=self.sites[peer].role == "master",
        )

    def _followed_sites(self, index: int) -> int:
        """Returns the set of sites that a site follows, as bits."""
        return sum(1 << n for n, share in enumerate(self.alpha[index]) if share > 0.0)

    def _speed_limit(self, site: str) -> tuple[float, ...]:
        """Returns the largest speed of each joint of a site, rad/s.

        The result is () if the sites do not share joint angles.
        """
        spec = self.sites[site]
        joints = self.arms[site].counts.joints
        if spec.task.space != "joints":
            return ()
        return tuple(np.broadcast_to(spec.limits.qd_limit_rad_s, joints).tolist())

    def ramp(
        self, site: str, shares: dict[str, float], start_ns: int, ramp_s: float
    ) -> DominanceRamp:
        """Returns a change of a site's dominance factors in the form of the core.

        Args:
            site: the site.
            shares: its dominance factors after the change, by peer.
            start_ns: when the change begins, ns since the epoch.
            ramp_s: how long the change lasts, s.
        """
        alpha = tuple(shares.get(peer, 0.0) for peer in self.peers(site))
        return DominanceRamp(start_ns, start_ns + round(ramp_s * 1e9), alpha)

    def scripted_ramps(self, site: str) -> list[DominanceRamp]:
        """Returns the changes of a site's dominance factors on the timeline."""
        return [
            self.ramp(site, change.to, change.start_ns, change.ramp_s)
            for change in self.timeline
            if change.dominance == site
        ]

    def without_hands(self) -> "Scenario":
        """Returns the same experiment without operators."""
        sites = {
            name: msgspec.structs.replace(spec, hands=()) for name, spec in self.sites.items()
        }
        drawn = {key: origin for key, origin in self.drawn.items() if ".hands." not in key}
        return msgspec.structs.replace(self, sites=sites, drawn=drawn)
