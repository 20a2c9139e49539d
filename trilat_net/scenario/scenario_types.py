"""The types of a complete scenario: sites, scripted changes, itself, and the core's setup of
each site.

Invariant: keys end in their unit; symbols are the paper's. `Scenario.text` is canonical: it
loads to the same scenario, and its SHA-256 names the experiment. A change names the time from
which it holds and is complete in itself.
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
    """The rule for a peer whose sample in use is too old.

    Attributes:
        action: "use": goes on with it; "hold": stays at the last reference; "brake": stays
            where the arm is; "glide": begins by waiting for all peers, lets its reference come
            to rest when none of a peer's samples came into use for a time, and aligns with its
            peers without a jump.
        age_ms: the age beyond which it is too old, ms; not of "glide".
        return_s: duration of the return once a fresh sample is in use, s; not of "glide".
        silence_ms: of "glide", the time without a new sample in use after which a peer is
            silent, ms.
        align_speed_rad_s: of "glide", how fast it goes to its peers, rad/s; of a place m/s.
        align_limit_rad: of "glide", the longest way that it goes by itself, rad; of a place m.
        on_lost: of "glide", "hold": holds while a peer is silent; "degrade": goes on without a
            master that is, as long as the others reach each other.
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
        """The rule as the core has it."""
        if self.action == "glide":
            silence_ns = round(self.silence_ms * 1e6)
            limits = self.align_speed_rad_s, self.align_limit_rad
            return site_setup.StaleRule(
                site_setup.StaleAction.GLIDE, silence_ns, 1, *limits, self.on_lost == "degrade"
            )
        return site_setup.StaleRule(
            site_setup.StaleAction[self.action.upper()],
            round(self.age_ms * 1e6),
            round(self.return_s * 1e9),
        )


SpeedLimit = Annotated[float, Meta(gt=0.0, le=10_000.0)]
SpeedLimits = Annotated[tuple[SpeedLimit, ...], Meta(min_length=1, max_length=MAX_JOINTS)]


GLIDE_TAU_RATE_NM_S = 1000.0
"""Under the rule "glide" a torque changes by 1 N m a millisecond at most, as Franka's arms ask
for it.
"""


class Limits(Frozen, frozen=True):
    """The limits of a site.

    Attributes:
        tau_limit_nm: largest control torque of a joint, N m; more is cut off. One number, or
            one per joint; left out, a chain has the efforts that its file states.
        qd_limit_rad_s: joint speed beyond which a run counts as diverged and ends, rad/s; so
            too. Under the rule "glide" the site is in fault in its place, and the run goes on.
        tau_rate_limit_nm_s: largest change of the control torque of a joint in a second, N m/s.
            Left out, there is none, but under the rule "glide" it is `GLIDE_TAU_RATE_NM_S`.
        qd_des_limit_rad_s: largest speed of the reference, rad/s; of a place m/s.
        q_min_rad: least angle of a joint, rad; only of the rule "glide": beyond it the site is
            in fault.
        q_max_rad: largest angle, likewise.
    """

    tau_limit_nm: Positive | PositiveJoints = 200.0
    qd_limit_rad_s: SpeedLimit | SpeedLimits = 100.0
    tau_rate_limit_nm_s: Positive | PositiveJoints | None = None
    qd_des_limit_rad_s: SpeedLimit | SpeedLimits | None = None
    q_min_rad: Real | Joints | None = None
    q_max_rad: Real | Joints | None = None

    @property
    def motion(self) -> site_setup.MotionLimits:
        """Those that the core has besides the first two."""
        return site_setup.MotionLimits(
            q_min=-math.inf if self.q_min_rad is None else self.q_min_rad,
            q_max=math.inf if self.q_max_rad is None else self.q_max_rad,
            qd_des_limit=math.inf
            if self.qd_des_limit_rad_s is None
            else self.qd_des_limit_rad_s,
            tau_rate=math.inf if self.tau_rate_limit_nm_s is None else self.tau_rate_limit_nm_s,
        )


class SiteSpec(Frozen, frozen=True):
    """One manipulator.

    Attributes:
        role: its role for a reader of figures; enters no formula.
        rate_hz: tick rate of its loop, Hz.
        q0_rad: start pose, rad.
        qd0_rad_s: start velocity, rad/s.
        on_stale: its rule for a peer whose samples are too old.
        task: what it follows: joints, or its end effector.
        plant: "simulated"; "external": an arm outside of the program, whose state is measured;
            or a class of one's own that moves the arm.
        view: delay, loss and order of the picture by which the site's user sees its peers, as
            of a link; None: the user sees the samples in use. It enters no formula.
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
        """Returns the hand that is led while the session runs; `is_open`: one that anybody may
        hold.
        """
        hands = (one for one in self.hands if isinstance(one, LiveHand))
        return next((one for one in hands if one.is_open or not is_open), None)


SITE_GROUPS: dict[str, type[Frozen]] = {
    "arm": Arm,
    "limits": Limits,
    "on_stale": OnStale,
    "task": Task,
}
"""Tables that a scenario may have for all sites, and each site for itself."""


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
"""What a site may be ordered, from outside (the first three) or by itself."""
TIMELINE_KEYS = ("at_s", "link", "dominance", "to", "ramp_s")
"""Keys of a change that a scenario may have."""


class Change(Frozen, frozen=True, omit_defaults=True):
    """One change. Exactly one of `link`, `dominance` and `site` is given; the last is of
    records alone.

    Attributes:
        at_s: when it takes effect, s after the epoch; on a link, for samples stamped from then
            on.
        link: the link that it changes, as in "m1->s".
        dominance: the site whose dominance factors it changes.
        to: the whole link from then on, or all factors of the row.
        ramp_s: duration of the linear change of the factors, s.
        site: the site that is given an order.
        order: that order, see `core.ticks.LifeOrder`.
        ticks: of "overrun", how many ticks the site did not make.
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
        """When it takes effect, ns since the epoch."""
        return round(self.at_s * 1e9)

    @property
    def after(self) -> LinkBase:
        """The link from then on."""
        return msgspec.convert(self.to, Link)


def scheduled_links(timeline: Sequence[Change], name: str) -> Iterator[tuple[int, LinkBase]]:
    """Yields the later states of a link, each with its first stamp, ns, in order."""
    for change in timeline:
        if change.link == name:
            yield change.start_ns, change.after


_ABSENT: dict[str, tuple[Any, ...]] = {
    **dict.fromkeys(("timeline", "environment"), ((), [])),
    **dict.fromkeys(("expect", "drawn", "urdf", "on_stale", "task", "sends"), ({},)),
    "plant": ("simulated",),
    **dict.fromkeys(
        ("tau_rate_limit_nm_s", "qd_des_limit_rad_s", "q_min_rad", "q_max_rad", "view"), (None,)
    ),
}
"""Keys that older scenarios lack, and their values that mean nothing; those are not in the
text.
"""
_SLAVE = 2
"""The slave's place in a palette of colours."""
_NUMBERS = re.compile(r"\[\n(?:    [-+.\de]+,\n)+\]")
"""A list of numbers, one a line."""


def _drop_unused(arm: dict[str, Any]) -> None:
    """Leaves out of an arm's table what its kind of arm has not, and what means nothing."""
    defaults = msgspec.to_builtins(Arm())
    planar = () if arm["urdf"] else (*ArmLinks._fields, "g_m_s2")
    unused = ArmLinks._fields if arm["urdf"] else ()
    for key, value in list(arm.items()):
        if key in unused or (key not in planar and value == defaults[key]):
            del arm[key]


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
        seed: every random draw is a function of it.
        scheme: "second_order" or "digital", see `Scheme`.
        sites: the manipulators, in order; the first leads a live session.
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
        """Takes the text along: a default that is left out of it is known by its identity
        alone.
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
                path = f"sites.{name}.arm" + (f".{error.path}" if error.path else "")
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
        """The law of every site, with what it takes of the dominance factors at the start."""
        laws = [spec.control for spec in self.sites.values()]
        return tuple(law.resolve_shares(self.names, self.alpha) for law in laws)

    @property
    def beta(self) -> Array | None:
        """Left null vector of Upsilon, shape (N,), sum 1, Eq. (20); None if alpha is reducible."""
        return (
            dominance.perron_vector(self.alpha)
            if dominance.is_irreducible(self.alpha)
            else None
        )

    @cached_property
    def text(self) -> str:
        """The canonical TOML text."""
        tables: dict[str, Any] = msgspec.to_builtins(self)
        words = {key: tables.pop(key) for key in ("name", "title", "about", "assumed")}
        words = {key: value for key, value in words.items() if value}
        sites = tables["sites"].values()
        for site in sites:
            _drop_unused(site["arm"])
        for table in (
            tables,
            *sites,
            *(site[group] for site in sites for group in ("control", "limits")),
        ):
            for key, absent in _ABSENT.items():
                if key in table and table[key] in absent:
                    del table[key]
        urdf = tables.pop("urdf", None)
        numbers = _NUMBERS.sub(
            lambda one: " ".join(one[0].split()).replace("[ ", "[").replace(", ]", "]"),
            tomli_w.dumps(tables),
        )
        files = tomli_w.dumps({"urdf": urdf}, multiline_strings=True) if urdf else ""
        return tomli_w.dumps(words, multiline_strings=True) + numbers + files

    @cached_property
    def sha256(self) -> str:
        """The hash of the canonical text, which names the experiment."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def assign_colours(self, colours: int) -> list[int]:
        """Returns the places of a palette in the order of the sites; sites beyond them begin
        anew.
        """
        free = list(range(colours))
        order = []
        roles = [site.role for site in self.sites.values()]
        for n, role in enumerate(roles[:colours]):
            kept = [place for place in free if place != _SLAVE or "slave" not in roles[n:]]
            order.append(_SLAVE if role == "slave" and _SLAVE in free else kept[0])
            free.remove(order[-1])
        return [*order, *free]

    def ticks(self, site: str) -> int:
        """Returns the number of ticks of a site."""
        return max(1, round(self.duration_s * self.sites[site].rate_hz))

    def peers(self, site: str) -> tuple[str, ...]:
        """Returns the peers of a site, in scenario order."""
        return tuple(name for name in self.names if name != site)

    def _all_links(self) -> list[LinkBase]:
        later = [
            link for name in self.links for _, link in scheduled_links(self.timeline, name)
        ]
        return [*self.links.values(), *later]

    @property
    def random(self) -> bool:
        """True if anything is drawn: then another seed is another run."""
        return bool(self.drawn) or self.links_random

    @property
    def links_random(self) -> bool:
        """True if some link draws its delays or losses while the run goes on."""
        return any(link.random for link in self._all_links())

    @property
    def measured(self) -> bool:
        """True if some link injects no delay: then the real network decides."""
        return any(link.measured for link in self._all_links())

    @property
    def external(self) -> tuple[str, ...]:
        """The sites whose arms are measured: they are outside of the program, or plants of
        one's own.
        """
        return tuple(name for name, spec in self.sites.items() if spec.plant != "simulated")

    @property
    def slave(self) -> str:
        """The first site whose role is slave, else the last one."""
        return next(
            (name for name, spec in self.sites.items() if spec.role == "slave"), self.names[-1]
        )

    @property
    def outside(self) -> tuple[str, ...]:
        """The sites whose arms are outside of the program."""
        return tuple(name for name, spec in self.sites.items() if spec.plant == "external")

    @property
    def open_hands(self) -> tuple[str, ...]:
        """The sites whose arms anybody may hold who comes."""
        found = {name: spec.find_live_hand(is_open=True) for name, spec in self.sites.items()}
        return tuple(name for name, hand in found.items() if hand is not None)

    @property
    def sites_may_return(self) -> bool:
        """True if a session outlives its sites: each waits for its peers, and aligns with them
        anew.
        """
        return all(spec.on_stale.action == "glide" for spec in self.sites.values())

    def draw_seed(self, site: str) -> int:
        """Returns the seed for what code of one's own at a site draws."""
        return zlib.crc32(f"{self.seed}/{site}".encode())

    def channel(self, site: str) -> LawChannel:
        """Returns what the law of a site sends to its peers."""
        sends: SentVectorSpecs = getattr(self.sites[site].control, "sends", {})
        return build_channel(
            sends, site_setup.Layout.of_arm(self.arms[site].chain), len(self.names) - 1
        )

    def layout(self, site: str) -> site_setup.Layout:
        """Returns how many numbers the vectors of a site have."""
        live = self.sites[site].find_live_hand()
        actors = () if live is None else (live.actor,)
        found = site_setup.Layout.of_arm(
            self.arms[site].chain, self.channel(site).record_size, actors
        )
        return found._replace(bodies=7 * len(self.bodies_m(site)))

    def bodies_m(self, site: str) -> dict[str, tuple[float, float, float]]:
        """Returns the bodies that a site's plant moves besides its arm: their sizes along their
        axes, m.
        """
        plant = self.sites[site].plant
        return plant.bodies if isinstance(plant, OwnPlant) else {}

    def setup(self, site: str) -> site_setup.SiteSetup:
        """Returns all that the core needs to build a site."""
        spec = self.sites[site]
        arm = self.arms[site]
        control = self.controls[self.names.index(site)]
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
            actors=tuple(one.actor for one in (*spec.hands, *spec.environment)),
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
            rest=self._rest_gains(site)
            if spec.on_stale.action == "glide"
            else site_setup.RestGains(),
            bit=1 << self.names.index(site),
        )

    def motion_limits(self, site: str) -> site_setup.MotionLimits:
        """Returns the limits of a site's motion, with room for a start pose a little beyond a
        limit.

        A joint that starts beyond `q_min_rad` or `q_max_rad` by no more than the margin may be
        there during the whole run: its limit on that side lies the margin further out.
        """
        spec = self.sites[site]
        arm = self.arms[site]
        motion = spec.limits.motion
        start = np.array(spec.q0_rad)
        low, high = (
            np.broadcast_to(limit, start.shape) for limit in (motion.q_min, motion.q_max)
        )
        margin = np.full(start.shape, START_MARGIN_RAD)
        if arm.chain is not None:
            margin = np.array([start_margin(joint) for joint in arm.chain.joints])
        if not np.any((start < low) | (start > high)):
            return motion
        return motion._replace(
            q_min=tuple(
                np.where((start < low) & (start >= low - margin), low - margin, low).tolist()
            ),
            q_max=tuple(
                np.where(
                    (start > high) & (start <= high + margin), high + margin, high
                ).tolist()
            ),
        )

    def gains(self, site: str) -> site_setup.Gains:
        """Returns the gains of a site's law; under the rule `glide` its estimates are in a box."""
        spec = self.sites[site]
        arm = self.arms[site]
        gains = spec.control.gains(arm.theta)
        if spec.on_stale.action != "glide":
            return gains
        return bound_estimates(gains, arm, spec.limits.tau_limit_nm, spec.arm.g_m_s2)

    def _rest_gains(self, site: str) -> site_setup.RestGains:
        spec = self.sites[site]
        arm = self.arms[site]
        control = spec.control
        gains = control.linear_gains(arm.theta) or control.gains(arm.theta)
        own: Array = np.zeros(arm.counts.joints) + gains.Kp + gains.d
        limit = spec.limits.tau_limit_nm
        known = spec.arm.known
        return compute_rest_gains(
            arm=arm,
            q0=spec.q0_rad,
            law_damping=own,
            limit_nm=limit,
            rate_hz=spec.rate_hz,
            known=known,
        )

    def _link_setup(self, peer: str, site: str) -> site_setup.LinkSetup:
        name = f"{peer}->{site}"
        first = self.links[name]
        models: list[tuple[int, LinkBase]] = [(0, first), *scheduled_links(self.timeline, name)]
        return site_setup.LinkSetup(
            peer=peer,
            alpha=self.dominance[site].get(peer, 0.0),
            rate_hz=self.sites[peer].rate_hz,
            q0=self.arms[peer].shared_pose(self.sites[peer].q0_rad),
            key=link_key(self.seed, name),
            models=tuple(link.to_core_model(from_ns) for from_ns, link in models),
            traces=tuple(link.points for _, link in models),
            outages=tuple((round(a * 1e9), round(b * 1e9)) for a, b in first.outages_s),
            channel=self.channel(peer),
            index_at_peer=self.peers(peer).index(site),
            speed_limit=self._speed_limit(peer)
            if self.sites[site].on_stale.action == "glide"
            else (),
            bit=1 << self.names.index(peer),
            followed=sum(
                1 << n
                for n, share in enumerate(self.alpha[self.names.index(peer)])
                if share > 0.0
            ),
            dispensable=self.sites[peer].role == "master",
        )

    def _speed_limit(self, site: str) -> tuple[float, ...]:
        """Returns the largest speed of a site's joints, rad/s; () if peers do not get their
        angles.
        """
        spec = self.sites[site]
        joints = self.arms[site].counts.joints
        if spec.task.space != "joints":
            return ()
        return tuple(np.broadcast_to(spec.limits.qd_limit_rad_s, joints).tolist())

    def ramp(
        self, site: str, shares: dict[str, float], start_ns: int, ramp_s: float
    ) -> DominanceRamp:
        """Returns a change of a site's dominance factors, as the core has it."""
        alpha = tuple(shares.get(peer, 0.0) for peer in self.peers(site))
        return DominanceRamp(start_ns, start_ns + round(ramp_s * 1e9), alpha)

    def scripted_ramps(self, site: str) -> list[DominanceRamp]:
        """Returns the changes of a site's dominance factors on the timeline, as the core has
        them.
        """
        changes = [change for change in self.timeline if change.dominance == site]
        return [self.ramp(site, one.to, one.start_ns, one.ramp_s) for one in changes]

    def without_hands(self) -> "Scenario":
        """Returns the same experiment without operators."""
        sites = {
            name: msgspec.structs.replace(spec, hands=()) for name, spec in self.sites.items()
        }
        drawn = {key: one for key, one in self.drawn.items() if ".hands." not in key}
        return msgspec.structs.replace(self, sites=sites, drawn=drawn)
