"""Defines the data used to decide whether each condition of the stability theorem holds.

A condition of the theorem is called a premise. For example, the premise "the delays are
constant" is judged from `DelayQuantities`, which contains the delays of the network links.
`premises` and `observed_energy` create these objects from the log of a run. The package
`presentation` generates the sentences about them, so the wording can be changed without
touching the analysis.

Invariant:
    - An empty collection means that nothing of this kind was found in the run.
    - The quantities contain only names and numeric values, never sentences.
"""

from collections.abc import Mapping
from enum import Enum, auto
from typing import NamedTuple

from ...hooks import find_hook
from ...log import Log
from ...results import JsonObject
from ...scenario import Scenario
from ..dominance_history import PeerLoss
from ..timeline import Timeline
from ..torque_sources import WallEnergy


class FunctionalObstacle(Enum):
    """Reason why the energy function V of the stability proof does not exist for an arm.

    Without V, the stability of the run is judged by the other methods of the certificate, for
    example from the final motion.
    """

    UNKNOWN_PARAMETERS = auto()
    """The parameters theta of the arm are unknown."""
    LAW = auto()
    """The control law has no energy function V."""
    ORIENTATIONS = auto()
    """The arm follows orientations. Then ed is not the derivative of e."""


class MissingFunctional(NamedTuple):
    """Arms for which the energy function V does not exist, all for the same reason.

    The stability proof requires an energy function V that never rises. V exists only for some
    control laws.

    Attributes:
        obstacle: The reason.
        law: Tag of the control law, if the law is the reason. Otherwise empty.
        sites: Names of the sites.
    """

    obstacle: FunctionalObstacle
    law: str
    sites: tuple[str, ...]

    @classmethod
    def list_of_scenario(cls, scenario: Scenario) -> list["MissingFunctional"]:
        """Finds the arms of a scenario for which the energy function does not exist.

        The function exists only for certain control laws, and only if the true dynamic
        parameters of the arm are known. It is not defined if the end effector also follows the
        orientation of other arms.

        Args:
            scenario: The scenario.

        Returns:
            The sites of these arms, grouped by reason. Empty if the function exists for every
            arm.
        """
        sites_by_reason: dict[tuple[FunctionalObstacle, str], list[str]] = {}
        for site, spec in scenario.sites.items():
            law = ""
            if not spec.arm.known:
                obstacle = FunctionalObstacle.UNKNOWN_PARAMETERS
            elif not spec.control.has_functional:
                obstacle = FunctionalObstacle.LAW
                law = spec.control.tag
            elif spec.task.space == "pose":
                obstacle = FunctionalObstacle.ORIENTATIONS
            else:
                continue
            sites_by_reason.setdefault((obstacle, law), []).append(site)
        return [
            cls(obstacle, law, tuple(sites))
            for (obstacle, law), sites in sites_by_reason.items()
        ]


class LawQuantities(NamedTuple):
    """Evidence on whether the energy function V exists for the control law of every arm.

    V, the energy in the stability proof, exists only for adaptive laws.

    Attributes:
        missing: Sites without V, grouped by reason. The premise holds if this is empty.
    """

    missing: tuple[MissingFunctional, ...]


class ParameterFault(Enum):
    """Reason why an adaptive law cannot learn the true parameters theta of its arm.

    The proof assumes that there are constant parameters for which the law's model is exact.
    Each fault violates this assumption. The text of the premise names the affected sites.
    """

    OUTSIDE_BOX = auto()
    """Theta is outside the box in which the law keeps its estimates."""
    NEVER_LEARNT = auto()
    """A parameter is neither adapted nor known."""
    FRICTION = auto()
    """The law does not compensate all friction of the joints."""


class ParameterQuantities(NamedTuple):
    """Evidence on whether adaptive control laws can learn the parameters of their arms.

    The stability theorem requires the model in the law to include every load on the arm.

    Attributes:
        faults: Pairs of site name and reason, one per fault. Empty if the condition holds.
    """

    faults: tuple[tuple[str, ParameterFault], ...]


class GainQuantities(NamedTuple):
    """Evidence on whether the damping gains Kd of all sites are equal up to a factor.

    For example, Kd may be twice as large at one site, because the weights of the sites in V,
    the energy in the stability proof, compensate for the factor. Other differences cannot be
    compensated for in this way.

    Attributes:
        Kd: Gain of each site per joint, in N m s/rad, or in task space per coordinate, in N
            s/m.
        scales: Factor of each site, or `None` if the gains are not multiples of each other.
        is_positive: True if no gain is zero.
    """

    Kd: Mapping[str, tuple[float, ...]]
    scales: Mapping[str, float] | None
    is_positive: bool


class WallQuantities(NamedTuple):
    """Evidence on whether simulated walls add energy to the arms, which the theorem excludes.

    A wall whose force is computed once per tick generates energy. The wall adds no energy to
    the arm if the damping of the arm removes all of it.

    Attributes:
        walls: The walls that were touched, each with the energy that it generated and the
            required and actual damping of the arm.
    """

    walls: tuple[WallEnergy, ...]

    @property
    def active(self) -> tuple[WallEnergy, ...]:
        """Walls that generate at least as much energy as the touching arm's damping removes.

        A simulated wall computes its force once per tick, which generates energy. If the
        damping of the arm does not remove this energy, the contact may vibrate. Empty if there
        is no such wall.
        """
        return tuple(
            wall for wall in self.walls if wall.arm_damping_n_s_m <= wall.required_damping_n_s_m
        )


class DominanceQuantities(NamedTuple):
    """Evidence on whether the dominance factors are constant and yield weights for all sites.

    The stability theorem requires both, because its energy function V is the sum of the
    energies of the sites, multiplied by these weights.

    Attributes:
        changing: Sites whose dominance factors change.
        losses: Time spans in which sites continued without a peer.
        groups: Closed groups of sites, which follow no site outside their group. Empty if the
            factors change.
        weightless: Sites with zero weight in V.
        beta: Weight of each site in V, or `None` if the weights are not unique.
    """

    changing: tuple[str, ...] = ()
    losses: tuple[PeerLoss, ...] = ()
    groups: tuple[tuple[str, ...], ...] = ()
    weightless: tuple[str, ...] = ()
    beta: Mapping[str, float] | None = None


class AgeRange(NamedTuple):
    """Smallest and largest age of the samples from a peer that a control loop used.

    The age is the time since the sample was sent: the delay that the control law experiences.

    Attributes:
        peer: Site that sends the samples.
        site: Site that receives them.
        shortest_s: Smallest age, in s.
        longest_s: Largest age, in s.
    """

    peer: str
    site: str
    shortest_s: float
    longest_s: float


class DelayQuantities(NamedTuple):
    """Evidence on whether the delay of every network link was constant.

    The stability theorem requires this, because a varying delay can add energy to the arms.

    Attributes:
        varying: Age ranges on the links whose delay varies. Empty if the condition holds.
        constant_s: Delay of every other link that delivered a sample, in s.
    """

    varying: tuple[AgeRange, ...]
    constant_s: tuple[float, ...]


class Interruption(NamedTuple):
    """Time during which an arm did not follow the other arms.

    The stability theorem requires that all arms follow throughout the run. An arm stops
    following, for example, when no samples arrive and it holds its position.

    Attributes:
        site: Name of the site.
        from_s: Start, in s.
        to_s: End, in s.
    """

    site: str
    from_s: float
    to_s: float


class FollowingQuantities(NamedTuple):
    """Evidence on whether every arm followed the other arms throughout the run.

    The stability theorem requires this. It does not cover an arm that was held or stopped.

    Attributes:
        interruptions: The times during which a site held its position, braked, moved back to
            its reference or had stopped.
        limited_ticks: Number of ticks at which the reference velocity was limited, keyed by
            site name.
        is_halted: True if any site had stopped.
    """

    interruptions: tuple[Interruption, ...]
    limited_ticks: Mapping[str, int]
    is_halted: bool


class CutTorque(NamedTuple):
    """Finding that motors could not deliver the torque that the control law demanded.

    The stability theorem then does not apply, because it assumes motors without a torque limit.

    Attributes:
        site: Name of the site.
        joints: Names of the affected joints. Empty if the joints have no names.
        ticks: Number of ticks in which a torque was clipped at its limit.
    """

    site: str
    joints: tuple[str, ...]
    ticks: int


class TorqueQuantities(NamedTuple):
    """Evidence on whether every motor delivered the torque that its control law demanded.

    A motor clips torques above its limit, which the stability theorem does not allow for.

    Attributes:
        cut: Sites whose torque was clipped. The premise holds if this is empty.
    """

    cut: tuple[CutTorque, ...]


class TouchedStop(NamedTuple):
    """Finding that an arm reached the mechanical end stops of its joints.

    The stability theorem then does not apply, because its model of the arm has no end stops.

    Attributes:
        site: Name of the site.
        joints: Names of the joints that reached a stop. Empty if the joints have no names.
        from_s: Time of the first contact, in s.
    """

    site: str
    joints: tuple[str, ...]
    from_s: float


class StopQuantities(NamedTuple):
    """Evidence on whether any joint reached its mechanical end stops.

    The stability theorem requires that none did, because its model has no end stops.

    Attributes:
        touched: Sites whose arms reached their stops. Empty if the condition holds.
    """

    touched: tuple[TouchedStop, ...]


class AxisQuantities(NamedTuple):
    """Evidence on whether sites that follow each other do so along the same axes.

    In task space, an end effector may follow along only some axes, for example not in
    orientation. The condition fails if a follower uses an axis along which the followed site
    itself is free to move.

    Attributes:
        faults: Pairs (follower, followed site) with an axis that only the follower follows.
    """

    faults: tuple[tuple[str, str], ...]


class SingularPoseQuantities(NamedTuple):
    """Evidence on whether any arm came near a singular pose, such as a fully stretched arm.

    In a singular pose, the end effector cannot move in every direction, however fast the joints
    turn. The stability theorem does not cover such poses.

    Attributes:
        near_s: When the arm of each affected site first came near a singular pose, in s, keyed
            by site.
        least_values: Smallest singular value of each site's Jacobian, in m/rad. It is close to
            0 near a singular pose.
    """

    near_s: Mapping[str, float]
    least_values: Mapping[str, float]


class Supply(NamedTuple):
    """Energy that users and walls supplied to the arms, and the time without pushes at the end.

    The stability theorem assumes that they do not supply unlimited energy.

    Attributes:
        sources: Names of the sources.
        energy_j: Largest energy supplied in excess of the energy absorbed, in J.
        is_passive: True if this energy is only a rounding error.
        in_task_space: True if a site follows in task space. The supplied energy is computed
            with the filtered error r, which is then defined as qd - v, with the reference
            velocity v, instead of qd + Lambda e.
        released_s: Time after which no operator or wall pushes, in s.
        free_s: Duration of the motion after this time, in s.
        least_free_s: Shortest duration `free_s` for which the theorem is applied to the motion
            without pushes, in s.
    """

    sources: tuple[str, ...]
    energy_j: float
    is_passive: bool
    in_task_space: bool
    released_s: float
    free_s: float
    least_free_s: float


class OperatorQuantities(NamedTuple):
    """Evidence on whether operators and environments are passive.

    A passive operator never returns more energy than it received. If an operator is not
    passive, the energy V of the stability proof may rise.

    Attributes:
        unmeasured: Sites with external arms whose external torque is not recorded.
        weightless: Sites that are pushed although their weight in V is zero.
        supply: Energy supplied by operators and environments, or `None` if no push was
            recorded or if a pushed site has zero weight in V.
    """

    unmeasured: tuple[str, ...] = ()
    weightless: tuple[str, ...] = ()
    supply: Supply | None = None


class RecordQuantities(NamedTuple):
    """Evidence on whether the log has a record for every tick of every arm.

    The energy function V of the stability proof cannot be computed where records are missing.

    Attributes:
        unjudged_s: Time spans (start, end) in which records are missing although all sites were
            present, in s.
        is_whole: True if no records are missing at all, not even while sites were absent.
    """

    unjudged_s: tuple[tuple[float, float], ...]
    is_whole: bool


LEAST_ABSENCE_S = 0.1
"""Shortest absence of a site that counts, in s.

The records of sites that are present also end at times that differ by up to this much.
"""


class AbsentSpan(NamedTuple):
    """Time interval in which a site was absent from the session and executed no ticks.

    This happens, for example, when its process is stopped and restarted.

    Attributes:
        site: Name of the site.
        from_s: Start, in s after the start of the session.
        to_s: End, in s.
    """

    site: str
    from_s: float
    to_s: float

    @classmethod
    def list_of_log(cls, log: Log) -> "list[AbsentSpan]":
        """Finds the time intervals in which sites were absent from the session.

        A site is absent from the time at which it leaves until it joins again. If the session
        reported that the site left or was lost, it is also absent from its last record to the
        end of the run.

        Args:
            log: The log of the run.

        Returns:
            The intervals, sorted by start. Empty if no site was absent.
        """
        run_end_s = Timeline(log).end_s
        absent = []
        for site in log.sites:
            site_log = log[site]
            for first_tick, last_tick in log.absences.get(site, ()):
                absence_start_s = first_tick / site_log.rate_hz
                absence_end_s = (last_tick + 1) / site_log.rate_hz
                absent.append(cls(site, absence_start_s, absence_end_s))
            last_s = (site_log.last_tick + 1) / site_log.rate_hz
            kinds = {event.kind for event in log.events if event.about == site}
            has_left = bool(kinds & {"left", "lost"})
            if last_s < run_end_s - LEAST_ABSENCE_S and has_left:
                absent.append(cls(site, last_s, run_end_s))
        return sorted(absent, key=lambda span: span[1:])


class PresentStretch(NamedTuple):
    """Time interval between two absences, in which the processes of all arms were present.

    Attributes:
        from_s: Start, in s.
        to_s: End, in s.
        follow_from_s: Time from which all sites follow their peers, in s, or `None` if they
            never do.
        varying: Links (peer, site) whose delay varies after this time.
    """

    from_s: float
    to_s: float
    follow_from_s: float | None
    varying: tuple[tuple[str, str], ...] = ()


class PresenceQuantities(NamedTuple):
    """Evidence on whether the processes of all arms were present throughout the run.

    A process may leave a session and return. The stability theorem then applies to each
    interval between two absences.

    Attributes:
        absent: Time intervals in which sites were absent.
        stretches: The intervals between absences, in which all sites were present.
    """

    absent: tuple[AbsentSpan, ...]
    stretches: tuple[PresentStretch, ...]


class BooksQuantities(NamedTuple):
    """Evidence on whether the energies that control laws declare are correct.

    A control law may declare how much energy it stores. The declared energy is compared with
    the energy computed from recorded torques and velocities.

    Attributes:
        site: Site whose law has the largest error.
        residual_j: This error, in J.
        scale_j: Largest energy that occurs, in J, to which the error is compared.
    """

    site: str
    residual_j: float
    scale_j: float


class BookedTorqueQuantities(NamedTuple):
    """Evidence on whether control laws use the torque that the arms actually received.

    If a torque was clipped at a motor limit, a law that uses the demanded torque instead
    declares wrong energies.

    Attributes:
        cut: Sites whose torque was clipped at the limit of their actuators.
        unbooked: Sites in `cut` whose law uses a different torque from the one that the arm
            received.
    """

    cut: tuple[str, ...]
    unbooked: tuple[str, ...]


class SamplingQuantities(NamedTuple):
    """Evidence on whether laws account for nearly all energy that the arms receive.

    Between two ticks, the torque is constant while the arm continues to move. The law sees the
    arm only once per tick, and does not account for the energy that the torque supplies in
    between (the leak).

    Attributes:
        site: Site with the largest leak.
        leak_j: The largest leak, in J.
    """

    site: str
    leak_j: float


PremiseQuantities = (
    LawQuantities
    | ParameterQuantities
    | GainQuantities
    | WallQuantities
    | DominanceQuantities
    | DelayQuantities
    | FollowingQuantities
    | TorqueQuantities
    | StopQuantities
    | AxisQuantities
    | SingularPoseQuantities
    | OperatorQuantities
    | RecordQuantities
    | PresenceQuantities
    | BooksQuantities
    | BookedTorqueQuantities
    | SamplingQuantities
)
"""The quantities of any premise."""


class Premise(NamedTuple):
    """A condition of the stability theorem, with the result of checking it for one run.

    An example is that all network delays are constant. If a condition is not met, the theorem
    says nothing about the run.

    Attributes:
        name: Key of the premise, such as "delays".
        holds: True if the run meets the condition, False if not, `None` if this cannot be
            determined from the log.
        quantities: What the log shows about the condition.
    """

    name: str
    holds: bool | None
    quantities: PremiseQuantities

    @property
    def text(self) -> str:
        """A sentence for the user on what the log shows about the condition.

        For the premise "delays", for example, the sentence names the links whose delays varied.
        The package `presentation` generates it from the values in `quantities`.
        """
        return str(find_hook("describe a premise")(self.quantities))

    def to_json(self) -> JsonObject:
        """Returns the premise as one entry of the output of `trilat certify --json`.

        For example {"name": "torque", "holds": True, "text": ...}, where the text describes the
        evidence.
        """
        return {"name": self.name, "holds": self.holds, "text": self.text}
