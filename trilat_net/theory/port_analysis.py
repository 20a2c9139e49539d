"""Port analysis of a scenario's teleoperator.

Passivity, absolute stability, transparency, also as JSON values.

Invariant: operators and environments are off, and their torque at the equilibrium stays as a constant, so
that a held pose can be analysed too. An unstable loop has no steady oscillations: nothing but its
instability counts. Every result holds for the analysed band.
"""

import math
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from ..analysis.lyapunov_weights import compute_lyapunov_weights
from ..core.exogenous import TorqueKind, TorqueSource
from ..core.site_setup import Law
from ..core.two_link_arm import JOINTS
from ..core.vectors import Array
from ..errors import UsageError
from ..scenario import Scenario
from .delay_roots import compute_delay_spectrum
from .frequency_search import (
    HIGH_HZ,
    LOW_HZ,
    Minima,
    build_frequency_grid,
    cache_response,
    find_minima,
    find_resolved_hz,
    refine_frequencies,
)
from .linear_loop import LinearLoop, gather_site_arguments, linearise_loop
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .port_passivity import (
    EIGENVALUE_ROUNDING,
    Passivity,
    check_passivity,
    clamp_ports,
    find_best_weights,
    llewellyn_parameter,
    llewellyn_rounding,
)
from .port_response import (
    CLAMPED,
    Complex,
    LoopOutput,
    PoleAtZero,
    PortResponse,
    apply_loads,
    build_admittance,
    evaluate_transfer,
    find_longest_delay_s,
    find_pole_at_zero,
    find_site_ports,
    group_ports_by_joint,
    list_port_sites,
    parse_port_site,
    select_ports,
    to_imaginary_axis,
)
from .port_transparency import QUOTED_AT_HZ, Transparency, measure_transparency


def freeze_external_torques(now: OperatingConditions, rest: Equilibrium) -> OperatingConditions:
    """Returns the conditions with the torque of hands and environments held at what it is at the rest.

    Args:
        now: what the loop is made of.
        rest: where it is linearised.
    """
    x = gather_site_arguments(now, rest)
    sites = []
    for i, site in enumerate(now.sites):
        found = now.rates(i, x[i])
        torque = tuple((found.acted + found.held).tolist())
        sites.append(
            site._replace(actors=(TorqueSource(TorqueKind.RECORDED, a=torque),) if any(torque) else ())
        )
    return now._replace(sites=tuple(sites))


def linearise_teleoperator(now: OperatingConditions, rest: Equilibrium) -> LinearLoop:
    """Returns the loop that hands and environments meet at their ports.

    Args:
        now: what the loop is made of.
        rest: where it is linearised.
    """
    return linearise_loop(freeze_external_torques(now, rest), rest)


def build_proof_output(now: OperatingConditions, loop: LinearLoop) -> LoopOutput | None:
    """Returns how r_i = qd_i + Lambda (q_i - sum_j alpha_ij q_j(t - T_ij)), Eq. (6), (9), (10), is read off.

    Args:
        now: what the loop is made of.
        loop: the loop.

    Returns:
        None where a site has another law than the paper's, which has no r.
    """
    if any(site.gains.law is not Law.ADAPTIVE for site in now.sites):
        return None
    C, late = (
        loop.C.copy(),
        {float(delay_s): np.zeros_like(loop.C) for delay_s in now.age_s[now.alpha != 0.0]},
    )
    for i, site in enumerate(now.sites):
        for joint in range(JOINTS):
            row = JOINTS * i + joint
            C[row, _angle(loop, site.name, joint)] += site.gains.Lambda[joint]
            for j in np.flatnonzero(now.alpha[i]):
                seen = site.gains.Lambda[joint] * now.alpha[i, j]
                late[float(now.age_s[i, j])][row, _angle(loop, now.sites[j].name, joint)] -= seen
    return LoopOutput(C, tuple(sorted(late.items())))


def _angle(loop: LinearLoop, site: str, joint: int) -> int:
    return loop.names.index(f"{site}.q{joint + 1}")


def compute_proof_weights(now: OperatingConditions) -> Array:
    """Returns beta_i = pi_i / c_i of the corrected proof (docs/errata.md), sum N, shape (N,).

    Args:
        now: what the loop is made of.
    """
    return compute_lyapunov_weights(now.alpha, np.array([site.gains.Kd for site in now.sites])).beta


class TwoPort(NamedTuple):
    """Llewellyn's criterion for one joint of two sites.

    Attributes:
        sites: the two.
        joint: which joint, from 1 on; no hand is at the other joints.
        clamped: the third site, where it is clamped; "" where no hand is at it, or there is none.
        dips: the parameter over frequency, and where it is below 1.
    """

    sites: tuple[str, str]
    joint: int
    clamped: str
    dips: Minima


class PortAnalysis(NamedTuple):
    """What is said of the ports of a teleoperator: hands and environments are off.

    Attributes:
        sites: of the ports.
        band_hz: what was looked at, Hz.
        resolved_hz: up to where the phase of the delays was, Hz.
        verdict: of its roots: "stable", "unstable" or "at the edge".
        pole: what the admittance does where the frequency goes to zero.
        velocity: whether it is passive at all ports, hands being so with respect to qd.
        joints: the same for each joint alone, no hand being at the others.
        proof: whether it is passive with respect to r = qd + Lambda e; None where the law has no r.
        beta: the weights of the sites in that, shape (N,), sum N.
        true: whether all estimates at the rest are the truth; where not, the proof counts what they store,
            which a linear loop cannot show.
        absolute: the least eigenvalue under the best weights; stable with any hands where not negative.
        two_ports: Llewellyn's criterion for every pair of sites.
        felt: what a hand at each site feels of one other site.
        clamped_verdict: of the roots where that other site is clamped.
    """

    sites: tuple[str, ...]
    band_hz: tuple[float, float]
    resolved_hz: float
    verdict: str
    pole: PoleAtZero
    velocity: Passivity
    joints: dict[int, Passivity]
    proof: Passivity | None
    beta: Array
    true: bool
    absolute: Minima
    two_ports: tuple[TwoPort, ...]
    felt: tuple[Transparency, ...]
    clamped_verdict: str


def analyse_ports(
    scenario: Scenario,
    rest: Equilibrium,
    of: str | None = None,
    band_hz: tuple[float, float] = (LOW_HZ, HIGH_HZ),
) -> PortAnalysis:
    """Returns what there is to say of a scenario's ports at a rest.

    Args:
        scenario: the experiment.
        rest: where it is linearised.
        of: the site that hands at the others feel; None: the slave, or the last one where there is none.
        band_hz: what is looked at, Hz.

    Raises:
        ScenarioError: the scenario has no linear loop.
        UsageError: no site of that name, or an empty band.
    """
    if not 0.0 < band_hz[0] < band_hz[1]:
        raise UsageError(
            f"a band goes from a frequency to a higher one, not from {band_hz[0]:g} to {band_hz[1]:g} Hz"
        )
    now = derive_operating_conditions(scenario)
    loop = linearise_teleoperator(now, rest)
    of = _slave(scenario) if of is None else of
    Y = build_admittance(loop)
    w_rad_s = refine_frequencies(Y, build_frequency_grid(*band_hz, find_longest_delay_s(loop)))
    Y = cache_response(Y, w_rad_s)
    owner = np.array([list_port_sites(loop).index(parse_port_site(port)) for port in loop.inputs])
    hands = [site for site in list_port_sites(loop) if site != of]
    return PortAnalysis(
        sites=list_port_sites(loop),
        band_hz=band_hz,
        resolved_hz=find_resolved_hz(*band_hz, find_longest_delay_s(loop)),
        verdict=compute_delay_spectrum(loop, 1).verdict,
        pole=find_pole_at_zero(loop),
        velocity=check_passivity(Y, w_rad_s),
        joints={
            joint: check_passivity(select_ports(Y, places), w_rad_s)
            for joint, places in group_ports_by_joint(loop).items()
        },
        proof=_proof(now, loop, w_rad_s),
        beta=compute_proof_weights(now),
        true=all(np.allclose(own, site.theta) for own, site in zip(rest.theta_hat, now.sites, strict=True)),
        absolute=find_minima(
            lambda w: find_best_weights(Y(w), owner).margin,
            w_rad_s,
            tolerance=lambda w: np.full(len(w), EIGENVALUE_ROUNDING),
        ),
        two_ports=_two_ports(loop, Y, w_rad_s),
        felt=tuple(one for site in hands for one in measure_transparency(loop, site, of)),
        clamped_verdict=compute_delay_spectrum(apply_loads(loop, {of: CLAMPED}), 1).verdict,
    )


def _slave(scenario: Scenario) -> str:
    return next((name for name, site in scenario.sites.items() if site.role == "slave"), scenario.names[-1])


def _proof(now: OperatingConditions, loop: LinearLoop, w_rad_s: Array) -> Passivity | None:
    output = build_proof_output(now, loop)
    beta = np.repeat(
        compute_proof_weights(now), [len(find_site_ports(loop, site)) for site in list_port_sites(loop)]
    )
    if output is None or not (beta > 0.0).all():
        return None
    return check_passivity(lambda w: evaluate_transfer(loop, to_imaginary_axis(w), output), w_rad_s, beta)


def _two_ports(loop: LinearLoop, Y: PortResponse, w_rad_s: Array) -> tuple[TwoPort, ...]:
    found = []
    for pair in combinations(list_port_sites(loop), 2):
        others = [site for site in list_port_sites(loop) if site not in pair]
        for clamped in ("", *others) if len(others) == 1 else ("",):
            places = find_site_ports(loop, clamped) if clamped else []
            for joint, keep in group_ports_by_joint(loop).items():
                kept = [port for port in keep if parse_port_site(loop.inputs[port]) in pair]
                found.append(TwoPort(pair, joint, clamped, _llewellyn(Y, kept, places, w_rad_s)))
    return tuple(found)


def _llewellyn(Y: PortResponse, keep: list[int], clamped: list[int], w_rad_s: Array) -> Minima:
    def left(w: Array) -> Complex:
        return clamp_ports(Y(w), keep, clamped)

    return find_minima(
        lambda w: llewellyn_parameter(left(w)),
        w_rad_s,
        level=1.0,
        tolerance=lambda w: llewellyn_rounding(left(w)),
    )


def ports_to_json(section: PortAnalysis) -> dict[str, Any]:
    """Returns the section as plain values, as for JSON; infinite numbers are None.

    Args:
        section: what there is to say.
    """
    return {
        "sites": list(section.sites),
        "band_hz": list(section.band_hz),
        "resolved_hz": section.resolved_hz,
        "roots": section.verdict,
        "pole_at_zero": {"order": section.pole.order, "passive": section.pole.passive},
        "passive_qd": _passivity_facts(section.velocity),
        "passive_qd_of_joint": {str(joint): _passivity_facts(one) for joint, one in section.joints.items()},
        "passive_r": None if section.proof is None else _passivity_facts(section.proof),
        "beta": section.beta.tolist(),
        "estimates_true": section.true,
        "absolute": _dips_facts(section.absolute),
        "llewellyn": [
            {"sites": list(one.sites), "joint": one.joint, "clamped": one.clamped, **_dips_facts(one.dips)}
            for one in section.two_ports
        ],
        "roots_clamped": section.clamped_verdict,
        "felt": [_felt_facts(one) for one in section.felt],
    }


def _passivity_facts(one: Passivity) -> dict[str, Any]:
    lacking = one.lacking_nm_s_rad
    return {**_dips_facts(one.dips), "lacking_nm_s_rad": lacking if math.isfinite(lacking) else None}


def _dips_facts(one: Minima) -> dict[str, Any]:
    return {
        "holds": not one.below,
        "least": one.least,
        "least_hz": one.least_hz,
        "fails_hz": [list(span) for span in one.below],
    }


def _felt_facts(one: Transparency) -> dict[str, Any]:
    free, clamped = one.size_at(QUOTED_AT_HZ)
    return {
        "at": one.at,
        "of": one.of,
        "joint": one.joint,
        "free_at_1_hz_nm_s_rad": free,
        "clamped_at_1_hz_nm_s_rad": clamped,
        "band_hz": list(one.band_hz),
        "softest_nm_s_rad": one.softest_nm_s_rad,
        "stiffest_nm_s_rad": one.stiffest_nm_s_rad,
        "width_db": one.width_db,
    }
