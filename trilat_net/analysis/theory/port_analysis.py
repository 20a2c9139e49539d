"""Analyses what operators feel in coupled arms, and whether the arms stay stable.

A place where an operator or an environment touches an arm is called a port, as in electrical
networks. A port has two variables: the torque that acts on a joint, and the velocity of the
joint. `PortAnalysis.of_scenario` examines three properties:

- Passivity: the arms never return more energy at their ports than they received there.
- Absolute stability: the arms are stable with any passive operators.
- Transparency: what an operator feels while another arm moves freely or is clamped.

If end effectors follow each other instead of joints, the ports are at the end effectors, along
the followed axes. The joint angles q are then replaced by x = J q and z = N' q, where J is the
Jacobian of the followed axes at rest, and N a basis of the joint motions that leave these axes
unchanged. A force F on the end effector acts as the joint torque J' F. Ports are numbered by
their axis: 1 to 3 for the position, 4 to 6 for rotations.

Invariant:
    - Operators and environments are removed from the loop, but their torque at rest remains as
      a constant, which makes it possible to analyse a held pose.
    - For an unstable loop only the instability is reported, because this loop has no steady
      oscillations.
    - Every result holds for the analysed frequency band.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space

from ...core import POSITION, Array, SiteSetup, TorqueKind, TorqueSource
from ...errors import UsageError, count_nouns
from ...results import finite_or_none
from ...scenario import TASK_AXES, Scenario
from ..arm_rows import build_arm_rows
from ..blas_threads import limit_blas_threads
from ..dominance_history import compute_lyapunov_weights
from . import frequency_search, port_response
from .characteristic_roots import Complex, Spectrum
from .linear_loop import LinearLoop
from .operating_point import Equilibrium, OperatingConditions
from .port_passivity import (
    EIGENVALUE_ROUNDING,
    HandMatrices,
    Passivity,
    check_against_hands,
    clamp_ports,
    find_best_weights,
    llewellyn_parameter,
    llewellyn_rounding,
)
from .port_response import QUOTED_AT_HZ, Transparency
from .site_dynamics import ArgumentLayout, compute_following, place_arm


def freeze_external_torques(
    conditions: OperatingConditions, rest: Equilibrium
) -> OperatingConditions:
    """Replaces operators and environments by the constant torque that they apply at rest.

    The response of the arms then excludes the stiffness and damping of operators.

    Args:
        conditions: The sites, gains and delays of the loop.
        rest: The equilibrium, at which the torques are computed.
    """
    arguments = conditions.gather_site_arguments(rest)
    sites = []
    all_rates = conditions.evaluate_rates(arguments)
    for site, rates in zip(conditions.sites, all_rates, strict=True):
        rest_torque = rates.external + rates.held
        torque = tuple(rest_torque.tolist())
        actors: tuple[TorqueSource, ...] = ()
        if any(torque):
            actors = (TorqueSource(TorqueKind.RECORDED, a=torque),)
        sites.append(site._replace(actors=actors))
    return conditions._replace(sites=tuple(sites))


def linearise_teleoperator(conditions: OperatingConditions, rest: Equilibrium) -> LinearLoop:
    """Builds the linear model of the arms and their coupling, excluding operators and walls.

    Operators and walls act at the joints, which are the ports of the model.

    Args:
        conditions: The sites, gains and delays of the loop.
        rest: The equilibrium.
    """
    frozen = freeze_external_torques(conditions, rest)
    return _move_ports_to_end_effectors(frozen, rest, LinearLoop.of_conditions(frozen, rest))


def build_proof_output(
    conditions: OperatingConditions, loop: LinearLoop
) -> port_response.LoopOutput | None:
    """Returns the output of a loop with respect to which the paper proves passivity.

    The output is the filtered error r_i = qd_i + Lambda (q_i - sum_j alpha_ij q_j(t - T_ij)) of
    each site i, Eq. (6), (9), (10), where q are the joint angles, qd the velocities, Lambda a
    gain, alpha_ij the dominance factor with which site i follows site j, and T_ij the delay
    from j to i. In task space it is J r with the Jacobian J, and positions take the place of q.

    Args:
        conditions: The sites, gains and delays of the loop.
        loop: The linear model of the loop.

    Returns:
        The output, or `None` if there is no proof: for laws other than the paper's, for
            orientations, and for axes that a peer does not follow.
    """
    sites = conditions.sites
    if any(not site.gains.is_adaptive or site.gains.absolute for site in sites):
        return None
    if sites[0].layout.task and sites[0].layout.shared > POSITION:
        return None

    C = loop.C.copy()
    delays_s = conditions.age_s[conditions.alpha != 0.0]
    delayed = {float(delay_s): np.zeros_like(loop.C) for delay_s in delays_s}
    for i, site in enumerate(sites):
        Lambda = np.broadcast_to(site.gains.Lambda, site.layout.shared)
        ports = loop.find_site_ports(site.name)
        followed = _list_followed_axes(site)
        for port, joint in zip(ports, followed, strict=True):
            gain = Lambda[joint - 1]
            position = loop.names.index(f"{site.name}.q{joint}")
            C[port, position] += gain
            for j in np.flatnonzero(conditions.alpha[i]):
                peer = sites[j]
                if joint not in _list_followed_axes(peer):
                    continue
                peer_position = loop.names.index(f"{peer.name}.q{joint}")
                factor = gain * conditions.alpha[i, j]
                delay_s = float(conditions.age_s[i, j])
                delayed[delay_s][port, peer_position] -= factor
    delayed_terms = sorted(delayed.items())
    return port_response.LoopOutput(C, tuple(delayed_terms))


def compute_proof_weights(conditions: OperatingConditions) -> Array:
    """Computes the weights of the sites in the energy function of the stability proof.

    The weight of site i is beta_i = pi_i / c_i, where pi is the left eigenvector of the matrix
    of dominance factors, and c_i the ratio of the damping gain of site i to that of the first
    site. The proof is in docs/theory/errata-proof.md.

    Args:
        conditions: The sites, gains and dominance factors.

    Returns:
        The weights beta, shape (N,), for N sites. They sum to N.
    """
    Kd = np.full((len(conditions.sites), conditions.sites[0].layout.shared), np.nan)
    for site_Kd, site in zip(Kd, conditions.sites, strict=True):
        followed = [axis - 1 for axis in _list_followed_axes(site)]
        all_gains = np.broadcast_to(site.gains.Kd, site_Kd.shape)
        site_Kd[followed] = all_gains[followed]
    return compute_lyapunov_weights(conditions.alpha, Kd).beta


class _TwoPort(NamedTuple):
    """Result of Llewellyn's stability criterion for one joint of two arms.

    The criterion says whether the arms are stable with every passive operator or wall at both
    joints. No torque acts on the other joints.

    Attributes:
        sites: The two sites.
        joint: Number of the joint, or of the coordinate in task space, from 1.
        clamped: Name of the third site if it is clamped. Empty if it is free or does not exist.
        minima: Llewellyn's parameter over frequency, and the bands in which it is below 1,
            where the criterion is violated.
    """

    sites: tuple[str, str]
    joint: int
    clamped: str
    minima: frequency_search.Minima


class PortAnalysis(NamedTuple):
    """Result of analysing what operators feel in coupled arms, and the passivity of the arms.

    `PortAnalysis.of_scenario` computes it. A port is the place where an operator or an
    environment touches an arm, such as a joint.

    Attributes:
        scenario: The scenario of the coupled arms.
        band_hz: Lower and upper end of the analysed band, in Hz.
        resolved_hz: Frequency up to which the grid resolves the phase of the delays, in Hz.
        verdict: Verdict of the loop's characteristic roots: "stable", "unstable" or "at the
            edge".
        pole: Pole of the admittance at zero frequency.
        velocity: Passivity at all ports with respect to the velocities.
        joints: Passivity at the same joint of every arm, without operators at the other joints,
            keyed by joint number.
        proof: Passivity with respect to r = qd + Lambda e, or `None` if the law has no r.
        beta: Weights of the sites in `proof`, shape (N,), which sum to N.
        estimates_true: True if all estimates at the equilibrium are correct. Otherwise the
            proof counts the energy that they store, which a linear loop cannot show.
        absolute: Smallest eigenvalue over frequency with the best weights. If it is never
            negative, the loop is stable with any passive operators.
        two_ports: Llewellyn's criterion for every pair of sites.
        transparency: Transparency at each site, with one other site free and clamped.
        clamped_verdict: Verdict of the roots with this other site clamped.
        axes: Name of the axis in task space, keyed by port number. Empty in joint space.
        measured: Result with measured operators at the masters (see `check_against_hands`), or
            `None` if no operator was measured.
    """

    scenario: Scenario
    band_hz: tuple[float, float]
    resolved_hz: float
    verdict: str
    pole: port_response.PoleAtZero
    velocity: Passivity
    joints: dict[int, Passivity]
    proof: Passivity | None
    beta: Array
    estimates_true: bool
    absolute: frequency_search.Minima
    two_ports: tuple[_TwoPort, ...]
    transparency: tuple[Transparency, ...]
    clamped_verdict: str
    axes: Mapping[int, str] = MappingProxyType({})
    measured: frequency_search.Minima | None = None

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of the sites."""
        return self.scenario.names

    @property
    def kind(self) -> str:
        """Kind of ports at which operators push the arms: "joint", or "axis" in task space."""
        return "axis" if self.axes else "joint"

    @property
    def speed(self) -> str:
        """Symbol of the velocity at a port, for figures: "qd", or "xd" in task space."""
        return "xd" if self.axes else "qd"

    def group_failing_two_ports(self, *, by_joint: bool) -> list[list[_TwoPort]]:
        """Groups the two-ports for which Llewellyn's criterion fails.

        The two-ports of a group have the same sites, and the same third site clamped (or none).

        Args:
            by_joint: True to put two-ports of different joints into different groups.
        """
        groups: dict[tuple[object, ...], list[_TwoPort]] = {}
        for two_port in self.two_ports:
            if two_port.minima.below:
                joint = two_port.joint if by_joint else ""
                key = (two_port.sites, two_port.clamped, joint)
                groups.setdefault(key, []).append(two_port)
        return list(groups.values())

    def name_port(self, number: int) -> str:
        """Returns a name for the user of the joint or axis at which an operator pushes an arm.

        Examples are "joint 2" and "axis y".

        Args:
            number: Number of the joint, or in task space of the axis of the end effector, from
                1.
        """
        return f"{self.kind} {self.axes.get(number, number)}"

    def impedance_unit(self, number: int = 0) -> str:
        """Returns the unit of the impedance that an operator feels, for tables and figures.

        For a joint, this is N m s/rad.

        Args:
            number: Number of a joint, or in task space of an axis of the end effector, from 1.
                0 stands for all joints or axes together.
        """
        linear = "N s/m"
        angular = "N m s/rad"
        if not self.axes:
            return angular
        if number:
            return linear if number <= POSITION else angular
        has_rotations = max(self.axes) > POSITION
        return f"{linear} and {angular}" if has_rotations else linear

    @classmethod
    @limit_blas_threads()
    def of_scenario(
        cls,
        scenario: Scenario,
        rest: Equilibrium,
        of: str | None = None,
        band_hz: tuple[float, float] = (frequency_search.LOW_HZ, frequency_search.HIGH_HZ),
        hands: Sequence[HandMatrices] = (),
    ) -> "PortAnalysis":
        """Analyses what operators feel when they hold arms, and whether the arms are passive.

        The coupled arms are linearised about an equilibrium. Their response to torques at the
        joints is computed over a frequency band.

        Args:
            scenario: Scenario of the coupled arms.
            rest: The equilibrium.
            of: Site whose arm is free in one case and clamped in the other, to compare what
                operators feel at the other arms. If `None`, the slave is used, or the last site
                if there is no slave.
            band_hz: Lower and upper end of the band, in Hz.
            hands: Measured impedances of operators. Any of them may hold the arm of any master.

        Returns:
            Passivity, absolute stability, and the impedances that the operators feel.

        Raises:
            ScenarioError: The scenario cannot be linearised.
            UsageError: There is no site of that name, or the band is empty.
        """
        low, high = band_hz
        if not 0.0 < low < high:
            raise UsageError(
                "a band must go from a frequency above 0 Hz to a higher one, "
                f"not from {low:g} to {high:g} Hz"
            )

        conditions = OperatingConditions.derive(scenario)
        loop = linearise_teleoperator(conditions, rest)
        other_site = of or scenario.slave

        sites = loop.sites
        delay_s = loop.longest_delay_s
        grid = frequency_search.build_frequency_grid(low, high, delay_s)
        w_rad_s, Y = frequency_search.refine_response(
            port_response.build_admittance(loop), grid
        )

        joints = {
            joint: Passivity.check(port_response.select_ports(Y, ports), w_rad_s)
            for joint, ports in loop.ports_by_joint.items()
        }
        transparency: list[Transparency] = []
        for site in sites:
            if site != other_site:
                transparency += Transparency.measure(loop, site, other_site)

        clamped_loop = loop.clamp_site(other_site)
        held_hands = _locate_hands(scenario, conditions, rest=rest, loop=loop, hands=hands)
        return cls(
            scenario=scenario,
            band_hz=band_hz,
            resolved_hz=frequency_search.find_resolved_hz(low, high, delay_s),
            verdict=Spectrum.of_loop(loop, 1).verdict,
            pole=port_response.PoleAtZero.of_loop(loop),
            velocity=Passivity.check(Y, w_rad_s),
            joints=joints,
            proof=_check_proof(conditions, loop, w_rad_s),
            beta=compute_proof_weights(conditions),
            estimates_true=_are_estimates_true(conditions, rest),
            absolute=_check_absolute_stability(loop, Y, w_rad_s),
            two_ports=_check_two_ports(loop, Y, w_rad_s),
            transparency=tuple(transparency),
            clamped_verdict=Spectrum.of_loop(clamped_loop, 1).verdict,
            axes=_name_ports(conditions),
            measured=check_against_hands(
                Y, w_rad_s, held=held_hands.hands, places=held_hands.places
            ),
        )

    def to_json(self) -> dict[str, Any]:
        """Converts an analysis of what operators feel to plain values for JSON.

        Infinite values become `None`, because JSON cannot represent them.
        """
        measured = self.measured
        return {
            "sites": list(self.sites),
            "band_hz": list(self.band_hz),
            "resolved_hz": self.resolved_hz,
            "roots": self.verdict,
            "pole_at_zero": {"order": self.pole.order, "passive": self.pole.passive},
            "passive_qd": _passivity_to_json(self.velocity),
            "passive_qd_of_joint": {
                self.axes.get(joint, str(joint)): _passivity_to_json(passivity)
                for joint, passivity in self.joints.items()
            },
            "passive_r": None if self.proof is None else _passivity_to_json(self.proof),
            "beta": self.beta.tolist(),
            "estimates_true": self.estimates_true,
            "absolute": _minima_to_json(self.absolute),
            "measured_operators": None if measured is None else _minima_to_json(measured),
            "llewellyn": [
                {
                    "sites": list(two_port.sites),
                    "joint": self.axes.get(two_port.joint, two_port.joint),
                    "clamped": two_port.clamped,
                    **_minima_to_json(two_port.minima),
                }
                for two_port in self.two_ports
            ],
            "roots_clamped": self.clamped_verdict,
            "felt": [
                {
                    **_transparency_to_json(transparency),
                    "joint": self.axes.get(transparency.joint, transparency.joint),
                }
                for transparency in self.transparency
            ],
        }


def _are_estimates_true(conditions: OperatingConditions, rest: Equilibrium) -> bool:
    """Returns True if every estimate at the equilibrium is the true parameter."""
    for theta_hat, site in zip(rest.theta_hat, conditions.sites, strict=True):
        if site.gains.is_user:
            continue
        if not np.allclose(theta_hat[: len(site.theta)], site.theta):
            return False
    return True


def _check_absolute_stability(
    loop: LinearLoop,
    Y: port_response.PortResponse,
    w_rad_s: Array,
) -> frequency_search.Minima:
    """Computes the margin of absolute stability over frequency.

    Arms are absolutely stable if they remain stable with every passive hand or wall. The
    weights of the ports are chosen so that the margin is as large as possible.

    Args:
        loop: The loop.
        Y: Admittance at all ports.
        w_rad_s: Frequencies, in rad/s.
    """
    owners = _find_owners(loop)
    return frequency_search.Minima.find(
        lambda w: find_best_weights(Y(w), owners).margin,
        w_rad_s,
        tolerance=lambda w: np.full(len(w), EIGENVALUE_ROUNDING),
    )


class _HeldHands(NamedTuple):
    """End effectors (tips) of the masters' arms, and the measured human hands that hold them.

    A hand adds mass, damping and stiffness, which can make the arms stable or unstable.

    Attributes:
        hands: For each master, the operators that may hold its end effector.
        places: For each master, the matrix from the velocities at all ports to the velocity of
            its end effector, shape (n, p).
    """

    hands: list[Sequence[HandMatrices]]
    places: list[Array]


def _locate_hands(
    scenario: Scenario,
    conditions: OperatingConditions,
    *,
    rest: Equilibrium,
    loop: LinearLoop,
    hands: Sequence[HandMatrices],
) -> _HeldHands:
    """Finds the end effectors of the masters' arms, at which measured human hands may act.

    Args:
        scenario: The experiment.
        conditions: The coupled arms.
        rest: Pose of rest of all arms.
        loop: The loop, linearised at this pose.
        hands: The measured hands.

    Raises:
        UsageError: An operator was measured along other axes than an end effector has.
    """
    places: list[Array] = []
    for site, site_q in zip(conditions.sites, rest.q, strict=True):
        if not hands or scenario.sites[site.name].role != "master":
            continue

        q = site_q[np.newaxis, : site.layout.joints]
        ports = loop.find_site_ports(site.name)
        arm = build_arm_rows(scenario, site.name)
        end_effector = arm.place_end_effector(q, np.zeros_like(q))
        J = end_effector.J[0]
        if any(len(hand.B) != len(J) for hand in hands):
            raise UsageError(
                f"{site.name}: the end effector moves along {count_nouns(len(J), 'axis')}, "
                "but a hand was measured along a different number of axes"
            )

        tip_by_ports = np.zeros((len(J), len(loop.inputs)))
        if site.layout.task:
            # the ports are axes already
            for axis, port in zip(_list_followed_axes(site), ports, strict=True):
                if axis <= len(J):
                    tip_by_ports[axis - 1, port] = 1.0
        else:
            tip_by_ports[:, ports] = J
        places.append(tip_by_ports)
    return _HeldHands([hands] * len(places), places)


def _find_owners(loop: LinearLoop) -> NDArray[np.int64]:
    """Returns for each port the index of its site in the linear model, shape (p,)."""
    sites = loop.sites
    owners = [sites.index(site) for site in loop.port_sites]
    return np.array(owners, dtype=np.int64)


def _check_proof(
    conditions: OperatingConditions,
    loop: LinearLoop,
    w_rad_s: Array,
) -> Passivity | None:
    """Checks over frequency the passivity on which the paper's stability proof rests.

    The output of the proof is r, the velocity plus a multiple of the error.

    Args:
        conditions: The coupled arms.
        loop: The linearised loop.
        w_rad_s: Frequencies, in rad/s.

    Returns:
        The passivity under the weights of the proof. `None` if there is no proof for this loop,
        or if some site has the weight zero.
    """
    output = build_proof_output(conditions, loop)
    beta = compute_proof_weights(conditions)[_find_owners(loop)]
    if output is None or not (beta > 0.0).all():
        return None

    def evaluate(w: Array) -> Complex:
        s = np.asarray(1j * w, np.complex128)
        return port_response.evaluate_transfer(loop, s, output)

    return Passivity.check(evaluate, w_rad_s, beta)


def _check_two_ports(
    loop: LinearLoop,
    Y: port_response.PortResponse,
    w_rad_s: Array,
) -> tuple[_TwoPort, ...]:
    """Checks for every pair of arms whether they are stable with every passive user and wall.

    Llewellyn's criterion is evaluated at each joint that both arms have. With three arms, the
    third one is once free and once clamped.
    """
    two_ports = []
    sites = loop.sites
    ports_by_joint = loop.ports_by_joint
    site_of_port = loop.port_sites
    for pair in combinations(sites, 2):
        others = [site for site in sites if site not in pair]
        clamped_sites = ["", *others] if len(others) == 1 else [""]
        for clamped in clamped_sites:
            clamped_ports = loop.find_site_ports(clamped) if clamped else []
            for joint, ports in ports_by_joint.items():
                pair_ports = [port for port in ports if site_of_port[port] in pair]
                if len(pair_ports) == len(pair):
                    minima = _check_llewellyn(Y, pair_ports, clamped_ports, w_rad_s)
                    two_ports.append(_TwoPort(pair, joint, clamped, minima))
    return tuple(two_ports)


def _check_llewellyn(
    Y: port_response.PortResponse,
    keep: list[int],
    clamped: list[int],
    w_rad_s: Array,
) -> frequency_search.Minima:
    """Evaluates Llewellyn's stability parameter of two joints over frequency.

    The arms are stable with any passive operators at the two joints if the parameter is never
    below 1.

    Args:
        Y: Admittance at all ports.
        keep: Indices of the two ports.
        clamped: Indices of the ports that are clamped. All others are free.
        w_rad_s: Frequencies, in rad/s.
    """
    return frequency_search.Minima.find(
        lambda w: llewellyn_parameter(clamp_ports(Y(w), keep, clamped)),
        w_rad_s,
        level=1.0,
        tolerance=lambda w: llewellyn_rounding(clamp_ports(Y(w), keep, clamped)),
    )


def _passivity_to_json(passivity: Passivity) -> dict[str, Any]:
    """Converts the passivity of a loop, and the lacking damping, to plain values."""
    return {
        **_minima_to_json(passivity.minima),
        "lacking_nm_s_rad": finite_or_none(passivity.lacking_nm_s_rad),
    }


def _minima_to_json(minima: frequency_search.Minima) -> dict[str, Any]:
    """Converts a curve's least value, and the bands below its limit, to plain values."""
    return {
        "holds": not minima.below,
        "least": minima.least,
        "least_hz": minima.least_hz,
        "fails_hz": [list(band) for band in minima.below],
    }


def _transparency_to_json(transparency: Transparency) -> dict[str, Any]:
    """Converts the impedances with another arm free and clamped to plain values.

    Args:
        transparency: The impedances that the operator feels.
    """
    free, clamped = transparency.interpolate_magnitudes(QUOTED_AT_HZ)
    return {
        "at": transparency.operator_site,
        "of": transparency.other_site,
        "joint": transparency.joint,
        "free_at_1_hz_nm_s_rad": free,
        "clamped_at_1_hz_nm_s_rad": clamped,
        "band_hz": list(transparency.band_hz),
        "softest_nm_s_rad": transparency.softest_nm_s_rad,
        "stiffest_nm_s_rad": transparency.stiffest_nm_s_rad,
        "width_db": transparency.ratio_db,
        "ratio_db": transparency.ratio_db,
        "difference_nm_s_rad": transparency.difference_nm_s_rad,
    }


def _list_followed_axes(site: SiteSetup) -> list[int]:
    """Lists the joints, or the axes of the end effector, with which an arm follows the others.

    Args:
        site: Setup of the site.

    Returns:
        Numbers of the coordinates, from 1. In joint space they are all joints.
    """
    if site.chain is None or site.chain.task is None:
        return list(range(1, site.layout.joints + 1))
    return [n for n, is_followed in enumerate(site.chain.task.axes, 1) if is_followed]


def _name_ports(conditions: OperatingConditions) -> dict[int, str]:
    """Returns the names of the axes, such as "y", along which operators move end effectors.

    Args:
        conditions: The coupled arms.

    Returns:
        The name of each followed axis, such as "y", by its number from 1. Empty if joints
        follow each other instead of end effectors.
    """
    if not conditions.sites[0].layout.task:
        return {}
    followed = sorted({n for site in conditions.sites for n in _list_followed_axes(site)})
    return {n: TASK_AXES[n - 1] for n in followed}


def _move_ports_to_end_effectors(
    conditions: OperatingConditions,
    rest: Equilibrium,
    loop: LinearLoop,
) -> LinearLoop:
    """Replaces joint angles by end effector coordinates in a linear model of coupled arms.

    Operators then act on the end effectors. The joint angles q of a site (process that runs one
    arm) become x = J q and z = N' q. J is the Jacobian of the followed axes at rest, and N a
    basis of the joint motions that leave these axes unchanged. A force F becomes the joint
    torque J' F.

    Args:
        conditions: The sites, gains and delays of the coupled arms.
        rest: The pose of rest about which the arms are linearised.
        loop: Linear model with joint torques as inputs and joint velocities as outputs.

    Returns:
        The model with forces and velocities of the end effectors. If joints follow each other
        instead of end effectors, the model is returned without a change.
    """
    if not conditions.sites[0].layout.task:
        return loop

    state_blocks = []
    inverse_blocks = []
    port_blocks = []
    names = []
    inputs = []
    outputs = []
    arguments = conditions.gather_site_arguments(rest)
    for site, x in zip(conditions.sites, arguments, strict=True):
        layout = ArgumentLayout.of_site(site)
        followed = _list_followed_axes(site)
        arm = place_arm(site, x[layout.q])
        full_J = compute_following(site, arm, x).J
        assert full_J is not None
        J: Array = full_J[[n - 1 for n in followed]]
        N = null_space(J)
        T = np.vstack([J, N.T])
        T_inverse = np.hstack([np.linalg.pinv(J), N])

        # the states of estimates, which come after those of the joints, are not converted
        site_states = [name for name in loop.names if name.startswith(f"{site.name}.")]
        estimates = site_states[2 * layout.joints :]
        unchanged = np.eye(len(estimates))
        state_blocks.append(block_diag(T, T, unchanged))
        inverse_blocks.append(block_diag(T_inverse, T_inverse, unchanged))
        port_blocks.append(J)

        free_names = [f"free{n + 1}" for n in range(N.shape[1])]
        names += [f"{site.name}.q{n}" for n in followed]
        names += [f"{site.name}.{name}" for name in free_names]
        names += [f"{site.name}.qd{n}" for n in followed]
        names += [f"{site.name}.{name}d" for name in free_names]
        names += estimates
        inputs += [f"{site.name}.tau{n}" for n in followed]
        outputs += [f"{site.name}.qd{n}" for n in followed]

    new_by_old = block_diag(*state_blocks)
    old_by_new = block_diag(*inverse_blocks)
    J = block_diag(*port_blocks)
    delayed = tuple(
        term._replace(A=new_by_old @ term.A @ old_by_new, B=new_by_old @ term.B @ J.T)
        for term in loop.delayed
    )
    return loop._replace(
        names=tuple(names),
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        A=new_by_old @ loop.A @ old_by_new,
        B=new_by_old @ loop.B @ J.T,
        C=J @ loop.C @ old_by_new,
        delayed=delayed,
    )
