"""Port analysis of a scenario's teleoperator: passivity, absolute stability, transparency, also
as JSON.

Invariant: operators and environments are off, and their torque at the equilibrium stays as a
constant, so that a held pose can be analysed too. An unstable loop has no steady oscillations:
nothing but its instability counts. Every result holds for the analysed band.

Sites that follow in task space have ports at their end effectors, along the followed axes: the
same loop in other coordinates. With J the Jacobian of a site's followed axes at rest and N a
basis of the joint motions that leave them alone, x = J q and z = N' q stand in place of q, so
that a force F on the end effector is the torque J' F and its velocity is x'. A port is numbered
as its coordinate, 1 to 3 a place, 4 to 6 turns, and its position's state is called "q" with
that number, as a joint's is.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space

from ..analysis.arm_rows import build_arm_rows
from ..analysis.dominance_history import compute_lyapunov_weights
from ..core.exogenous import TorqueKind, TorqueSource
from ..core.site_setup import Law, SiteSetup
from ..core.task_space import POSITION
from ..core.vectors import Array
from ..errors import UsageError, count_nouns
from ..results import finite_or_none
from ..scenario import Scenario
from ..scenario.arms import TASK_AXES
from . import frequency_search, port_response
from .characteristic_roots import compute_delay_spectrum
from .linear_loop import LinearLoop, gather_site_arguments, linearise_loop
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .port_passivity import (
    EIGENVALUE_ROUNDING,
    HandMatrices,
    Passivity,
    check_against_hands,
    check_passivity,
    clamp_ports,
    find_best_weights,
    llewellyn_parameter,
    llewellyn_rounding,
)
from .port_response import QUOTED_AT_HZ, Transparency, measure_transparency
from .site_dynamics import follow_peers, lay_out_arguments, place_arm


def freeze_external_torques(
    conditions: OperatingConditions, rest: Equilibrium
) -> OperatingConditions:
    """Returns the conditions with the torque of operators and environments constant as at the
    equilibrium.
    """
    x = gather_site_arguments(conditions, rest)
    sites = []
    for site, rates in zip(conditions.sites, conditions.evaluate_rates(x), strict=True):
        torque = tuple((rates.external + rates.held).tolist())
        constant = (TorqueSource(TorqueKind.RECORDED, a=torque),) if any(torque) else ()
        sites.append(site._replace(actors=constant))
    return conditions._replace(sites=tuple(sites))


def linearise_teleoperator(conditions: OperatingConditions, rest: Equilibrium) -> LinearLoop:
    """Returns the loop at whose ports operators and environments act, without them."""
    frozen = freeze_external_torques(conditions, rest)
    return use_end_effector_ports(frozen, rest, linearise_loop(frozen, rest))


def build_proof_output(
    conditions: OperatingConditions, loop: LinearLoop
) -> port_response.LoopOutput | None:
    """Returns the output r_i = qd_i + Lambda (q_i - sum_j alpha_ij q_j(t - T_ij)), Eq. (6),
    (9), (10).

    In task space it is J r, with places in q's stead. None if a site has another law than the
    paper's, which has no r, and where orientations are followed, or axes that a peer leaves
    free: there is no proof.
    """
    if any(
        site.gains.law is not Law.ADAPTIVE or site.gains.absolute for site in conditions.sites
    ):
        return None
    if conditions.sites[0].layout.task and conditions.sites[0].layout.shared > POSITION:
        return None
    C = loop.C.copy()
    delays_s = conditions.age_s[conditions.alpha != 0.0]
    delayed = {float(delay_s): np.zeros_like(loop.C) for delay_s in delays_s}
    for i, site in enumerate(conditions.sites):
        Lambda = np.broadcast_to(site.gains.Lambda, site.layout.shared)
        for row, joint in zip(
            port_response.find_site_ports(loop, site.name),
            list_followed_axes(site),
            strict=True,
        ):
            C[row, loop.names.index(f"{site.name}.q{joint}")] += Lambda[joint - 1]
            for j in np.flatnonzero(conditions.alpha[i]):
                if joint not in list_followed_axes(conditions.sites[j]):
                    continue
                angle = loop.names.index(f"{conditions.sites[j].name}.q{joint}")
                factor = Lambda[joint - 1] * conditions.alpha[i, j]
                delayed[float(conditions.age_s[i, j])][row, angle] -= factor
    return port_response.LoopOutput(C, tuple(sorted(delayed.items())))


def compute_proof_weights(conditions: OperatingConditions) -> Array:
    """Returns beta_i = pi_i / c_i of the corrected proof (docs/errata.md), sum N, shape (N,)."""
    Kd = np.full((len(conditions.sites), conditions.sites[0].layout.shared), np.nan)
    for own, site in zip(Kd, conditions.sites, strict=True):
        followed = [n - 1 for n in list_followed_axes(site)]
        own[followed] = np.broadcast_to(site.gains.Kd, own.shape)[followed]
    return compute_lyapunov_weights(conditions.alpha, Kd).beta


class TwoPort(NamedTuple):
    """Llewellyn's criterion for one joint of two sites.

    Attributes:
        sites: the two.
        joint: the joint, or coordinate of the task, from 1 on; no operator is at the others.
        clamped: the third site if it is clamped; "" if it is free, or there is none.
        minima: the parameter over frequency, and the bands where it is below 1.
    """

    sites: tuple[str, str]
    joint: int
    clamped: str
    minima: frequency_search.Minima


class PortAnalysis(NamedTuple):
    """The ports of a teleoperator, operators and environments off.

    Attributes:
        scenario: the teleoperator.
        band_hz: the analysed band, Hz.
        resolved_hz: the frequency up to which the grid follows the phase of the delays, Hz.
        verdict: of its roots: "stable", "unstable" or "at the edge".
        pole: the pole of the admittance at zero frequency.
        velocity: passivity at all ports with respect to qd.
        joints: the same for each joint alone, no operator at the others.
        proof: passivity with respect to r = qd + Lambda e; None if the law has no r.
        beta: the weights of the sites in that, shape (N,), sum N.
        estimates_true: True if all estimates at the equilibrium are true; otherwise the proof
            counts the energy that they store, which a linear loop cannot show.
        absolute: the least eigenvalue under the best weights; stable with any passive operators
            where it is not negative.
        two_ports: Llewellyn's criterion for every pair of sites.
        transparency: at each site, with one other site free and clamped.
        clamped_verdict: of the roots with that other site clamped.
        axes: names of the ports' numbers in task space, whose ports are forces along them; {}:
            joints.
        measured: with measured hands at the masters, see `check_against_hands`; None if there
            are none.
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
    two_ports: tuple[TwoPort, ...]
    transparency: tuple[Transparency, ...]
    clamped_verdict: str
    axes: Mapping[int, str] = MappingProxyType({})
    measured: frequency_search.Minima | None = None

    @property
    def sites(self) -> tuple[str, ...]:
        """Of the ports."""
        return self.scenario.names

    @property
    def kind(self) -> str:
        """What a port belongs to: a joint, or an axis of the task."""
        return "axis" if self.axes else "joint"

    @property
    def speed(self) -> str:
        """Symbol of the velocities at the ports."""
        return "xd" if self.axes else "qd"

    def name_port(self, number: int) -> str:
        """Returns the name of the ports of a number: "joint 2", or "axis y" of a task."""
        return f"{self.kind} {self.axes.get(number, number)}"

    def impedance_unit(self, number: int = 0) -> str:
        """Returns the unit of an impedance at the ports of a number; 0: at all of them."""
        turns = not self.axes or max(self.axes) > POSITION
        units = {
            "N s/m" if self.axes and port <= POSITION else "N m s/rad"
            for port in [number]
            if port
        }
        return " and ".join(units or (["N s/m"] if self.axes else []) + ["N m s/rad"] * turns)


def analyse_ports(
    scenario: Scenario,
    rest: Equilibrium,
    of: str | None = None,
    band_hz: tuple[float, float] = (frequency_search.LOW_HZ, frequency_search.HIGH_HZ),
    hands: Sequence[HandMatrices] = (),
) -> PortAnalysis:
    """Returns the analysis of a scenario's ports at an equilibrium, over a band, Hz.

    The site `of` is free and clamped for the others' transparency; None: the slave, or the last
    site. Of `hands` any may hold any master.

    Raises:
        ScenarioError: the scenario has no linear loop.
        UsageError: no site of that name, or an empty band.
    """
    low, high = band_hz
    if not 0.0 < low < high:
        raise UsageError(
            f"a band goes from a frequency to a higher one, not from {low:g} to {high:g} Hz"
        )
    conditions = derive_operating_conditions(scenario)
    loop = linearise_teleoperator(conditions, rest)
    of = of or scenario.slave
    sites = port_response.list_port_sites(loop)
    delay_s = port_response.find_longest_delay_s(loop)
    Y = port_response.build_admittance(loop)
    w_rad_s = frequency_search.refine_frequencies(
        Y, frequency_search.build_frequency_grid(*band_hz, delay_s)
    )
    Y = frequency_search.cache_response(Y, w_rad_s)
    return PortAnalysis(
        scenario=scenario,
        band_hz=band_hz,
        resolved_hz=frequency_search.find_resolved_hz(*band_hz, delay_s),
        verdict=compute_delay_spectrum(loop, 1).verdict,
        pole=port_response.find_pole_at_zero(loop),
        velocity=check_passivity(Y, w_rad_s),
        joints={
            joint: check_passivity(port_response.select_ports(Y, places), w_rad_s)
            for joint, places in port_response.group_ports_by_joint(loop).items()
        },
        proof=_check_proof(conditions, loop, w_rad_s),
        beta=compute_proof_weights(conditions),
        estimates_true=all(
            site.gains.law is Law.USER or np.allclose(own[: len(site.theta)], site.theta)
            for own, site in zip(rest.theta_hat, conditions.sites, strict=True)
        ),
        absolute=frequency_search.find_minima(
            lambda w: find_best_weights(Y(w), _find_owners(loop)).margin,
            w_rad_s,
            tolerance=lambda w: np.full(len(w), EIGENVALUE_ROUNDING),
        ),
        two_ports=_check_two_ports(loop, Y, w_rad_s),
        transparency=tuple(
            one for site in sites if site != of for one in measure_transparency(loop, site, of)
        ),
        clamped_verdict=compute_delay_spectrum(port_response.clamp_site(loop, of), 1).verdict,
        axes=name_ports(conditions),
        measured=check_against_hands(
            Y,
            w_rad_s,
            *_place_hands(
                scenario=scenario, conditions=conditions, rest=rest, loop=loop, hands=hands
            ),
        ),
    )


def _place_hands(
    scenario: Scenario,
    conditions: OperatingConditions,
    rest: Equilibrium,
    loop: LinearLoop,
    hands: Sequence[HandMatrices],
) -> tuple[list[Sequence[HandMatrices]], list[Array]]:
    """Returns the hands at each master, and its end effector's velocity by those at the ports."""
    places: list[Array] = []
    for site, own in zip(conditions.sites, rest.q, strict=True):
        if not hands or scenario.sites[site.name].role != "master":
            continue
        q = own[np.newaxis, : site.layout.joints]
        ports = port_response.find_site_ports(loop, site.name)
        J = build_arm_rows(scenario, site.name).place_end_effector(q, np.zeros_like(q)).J[0]
        if any(len(one.B) != len(J) for one in hands):
            raise UsageError(
                f"{site.name}: its end effector moves along {count_nouns(len(J), 'axis')}, "
                "a hand along others"
            )
        place = np.zeros((len(J), len(loop.inputs)))
        if site.layout.task:  # its ports are axes
            for n, port in zip(list_followed_axes(site), ports, strict=True):
                if n <= len(J):
                    place[n - 1, port] = 1.0
        else:
            place[:, ports] = J
        places.append(place)
    return [hands] * len(places), places


def _find_owners(loop: LinearLoop) -> NDArray[np.int64]:
    sites = port_response.list_port_sites(loop)
    return np.array(
        [sites.index(port_response.parse_port_site(port)) for port in loop.inputs],
        dtype=np.int64,
    )


def _check_proof(
    conditions: OperatingConditions, loop: LinearLoop, w_rad_s: Array
) -> Passivity | None:
    output = build_proof_output(conditions, loop)
    beta = compute_proof_weights(conditions)[_find_owners(loop)]
    if output is None or not (beta > 0.0).all():
        return None
    return check_passivity(
        lambda w: port_response.evaluate_transfer(
            loop, port_response.to_imaginary_axis(w), output
        ),
        w_rad_s,
        beta,
    )


def _check_two_ports(
    loop: LinearLoop, Y: port_response.PortResponse, w_rad_s: Array
) -> tuple[TwoPort, ...]:
    two_ports = []
    for pair in combinations(port_response.list_port_sites(loop), 2):
        others = [site for site in port_response.list_port_sites(loop) if site not in pair]
        for clamped in ("", *others) if len(others) == 1 else ("",):
            fixed = port_response.find_site_ports(loop, clamped) if clamped else []
            for joint, places in port_response.group_ports_by_joint(loop).items():
                keep = [
                    port
                    for port in places
                    if port_response.parse_port_site(loop.inputs[port]) in pair
                ]
                if len(keep) == len(pair):
                    two_ports.append(
                        TwoPort(pair, joint, clamped, _check_llewellyn(Y, keep, fixed, w_rad_s))
                    )
    return tuple(two_ports)


def _check_llewellyn(
    Y: port_response.PortResponse, keep: list[int], clamped: list[int], w_rad_s: Array
) -> frequency_search.Minima:
    return frequency_search.find_minima(
        lambda w: llewellyn_parameter(clamp_ports(Y(w), keep, clamped)),
        w_rad_s,
        level=1.0,
        tolerance=lambda w: llewellyn_rounding(clamp_ports(Y(w), keep, clamped)),
    )


def ports_to_json(ports: PortAnalysis) -> dict[str, Any]:
    """Returns a port analysis as plain values; infinite numbers are None."""
    return {
        "sites": list(ports.sites),
        "band_hz": list(ports.band_hz),
        "resolved_hz": ports.resolved_hz,
        "roots": ports.verdict,
        "pole_at_zero": {"order": ports.pole.order, "passive": ports.pole.passive},
        "passive_qd": _passivity_to_json(ports.velocity),
        "passive_qd_of_joint": {
            ports.axes.get(joint, str(joint)): _passivity_to_json(one)
            for joint, one in ports.joints.items()
        },
        "passive_r": None if ports.proof is None else _passivity_to_json(ports.proof),
        "beta": ports.beta.tolist(),
        "estimates_true": ports.estimates_true,
        "absolute": _minima_to_json(ports.absolute),
        "measured_operators": None
        if ports.measured is None
        else _minima_to_json(ports.measured),
        "llewellyn": [
            {
                "sites": list(one.sites),
                "joint": ports.axes.get(one.joint, one.joint),
                "clamped": one.clamped,
            }
            | _minima_to_json(one.minima)
            for one in ports.two_ports
        ],
        "roots_clamped": ports.clamped_verdict,
        "felt": [
            _transparency_to_json(one) | {"joint": ports.axes.get(one.joint, one.joint)}
            for one in ports.transparency
        ],
    }


def _passivity_to_json(one: Passivity) -> dict[str, Any]:
    return {
        **_minima_to_json(one.minima),
        "lacking_nm_s_rad": finite_or_none(one.lacking_nm_s_rad),
    }


def _minima_to_json(one: frequency_search.Minima) -> dict[str, Any]:
    return {
        "holds": not one.below,
        "least": one.least,
        "least_hz": one.least_hz,
        "fails_hz": [list(band) for band in one.below],
    }


def _transparency_to_json(one: Transparency) -> dict[str, Any]:
    free, clamped = one.interpolate_magnitudes(QUOTED_AT_HZ)
    return {
        "at": one.operator_site,
        "of": one.other_site,
        "joint": one.joint,
        "free_at_1_hz_nm_s_rad": free,
        "clamped_at_1_hz_nm_s_rad": clamped,
        "band_hz": list(one.band_hz),
        "softest_nm_s_rad": one.softest_nm_s_rad,
        "stiffest_nm_s_rad": one.stiffest_nm_s_rad,
        "width_db": one.ratio_db,
        "ratio_db": one.ratio_db,
        "difference_nm_s_rad": one.difference_nm_s_rad,
    }


def list_followed_axes(site: SiteSetup) -> list[int]:
    """Returns the coordinates that a site follows, from 1 on: of joint space all joints."""
    if site.chain is None or site.chain.task is None:
        return list(range(1, site.layout.joints + 1))
    return [n for n, on in enumerate(site.chain.task.axes, 1) if on]


def name_ports(conditions: OperatingConditions) -> dict[int, str]:
    """Returns what the ports of each number are called: the axes of a task, or {} for the
    joints.
    """
    if not conditions.sites[0].layout.task:
        return {}
    followed = sorted({n for site in conditions.sites for n in list_followed_axes(site)})
    return {n: TASK_AXES[n - 1] for n in followed}


def use_end_effector_ports(
    conditions: OperatingConditions, rest: Equilibrium, loop: LinearLoop
) -> LinearLoop:
    """Returns a loop with ports at the end effectors, if its sites follow with them; else the
    loop.
    """
    if not conditions.sites[0].layout.task:
        return loop
    blocks = []
    inverses = []
    names = []
    ports = []
    for site, x in zip(conditions.sites, gather_site_arguments(conditions, rest), strict=True):
        at = lay_out_arguments(site)
        followed = list_followed_axes(site)
        whole = follow_peers(site, place_arm(site, x[at.q]), x).J
        assert whole is not None
        J: Array = whole[[n - 1 for n in followed]]
        free = null_space(J)
        T = np.vstack([J, free.T])
        inverse = np.hstack([np.linalg.pinv(J), free])
        estimates = [name for name in loop.names if name.startswith(f"{site.name}.")][
            2 * at.joints :
        ]
        rest_of_site = np.eye(len(estimates))
        blocks.append(block_diag(T, T, rest_of_site))
        inverses.append(block_diag(inverse, inverse, rest_of_site))
        free_names = [f"free{n + 1}" for n in range(free.shape[1])]
        for kind, slow in (("q", ""), ("qd", "d")):
            names += [f"{site.name}.{kind}{n}" for n in followed]
            names += [f"{site.name}.{name}{slow}" for name in free_names]
        names += estimates
        ports.append(J)
    change = block_diag(*blocks)
    back = block_diag(*inverses)
    J = block_diag(*ports)
    numbers = [(site.name, n) for site in conditions.sites for n in list_followed_axes(site)]
    inputs, outputs = (
        tuple(f"{site}.{kind}{n}" for site, n in numbers) for kind in ("tau", "qd")
    )
    delayed = tuple(
        term._replace(A=change @ term.A @ back, B=change @ term.B @ J.T)
        for term in loop.delayed
    )
    return loop._replace(
        names=tuple(names),
        inputs=inputs,
        outputs=outputs,
        A=change @ loop.A @ back,
        B=change @ loop.B @ J.T,
        C=J @ loop.C @ back,
        delayed=delayed,
    )
