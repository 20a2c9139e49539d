"""All that is said of a teleoperator's ports: passivity, absolute stability, what hands feel of each other.

Law: of an unstable loop nothing counts but that: it has no steady oscillations, and nothing to be felt in
them. Every answer holds for the band that was looked at.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..errors import UsageError
from ..linear.conditions import Conditions, conditions
from ..linear.loop import Loop, Rest
from ..linear.roots import spectrum
from ..scenario import Scenario
from .absolute import left_at, llewellyn, llewellyn_rounding, weighed
from .curve import HIGH_HZ, LOW_HZ, Dips, dips, grid, refined, remembered, resolved_hz
from .load import CLAMPED, loaded
from .passivity import ROUNDING, Passivity, passivity
from .port import (
    Complex,
    PoleAtZero,
    Response,
    admittance,
    axes,
    longest_s,
    on_axis,
    part,
    pole_at_zero,
    ports_of,
    site_of,
    sites,
    transfer,
)
from .teleoperator import proof_output, proof_weights, teleoperator
from .transparency import Felt, felt


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
    dips: Dips


class PortSection(NamedTuple):
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
    absolute: Dips
    two_ports: tuple[TwoPort, ...]
    felt: tuple[Felt, ...]
    clamped_verdict: str


def port_section(
    scenario: Scenario,
    rest: Rest,
    of: str | None = None,
    band_hz: tuple[float, float] = (LOW_HZ, HIGH_HZ),
) -> PortSection:
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
    now = conditions(scenario)
    loop = teleoperator(now, rest)
    of = _slave(scenario) if of is None else of
    Y = admittance(loop)
    w_rad_s = refined(Y, grid(*band_hz, longest_s(loop)))
    Y = remembered(Y, w_rad_s)
    owner = np.array([sites(loop).index(site_of(port)) for port in loop.inputs])
    hands = [site for site in sites(loop) if site != of]
    return PortSection(
        sites=sites(loop),
        band_hz=band_hz,
        resolved_hz=resolved_hz(*band_hz, longest_s(loop)),
        verdict=spectrum(loop, 1).verdict,
        pole=pole_at_zero(loop),
        velocity=passivity(Y, w_rad_s),
        joints={joint: passivity(part(Y, places), w_rad_s) for joint, places in axes(loop).items()},
        proof=_proof(now, loop, w_rad_s),
        beta=proof_weights(now),
        true=all(np.allclose(own, site.theta) for own, site in zip(rest.theta_hat, now.sites, strict=True)),
        absolute=dips(
            lambda w: weighed(Y(w), owner).margin, w_rad_s, tolerance=lambda w: np.full(len(w), ROUNDING)
        ),
        two_ports=_two_ports(loop, Y, w_rad_s),
        felt=tuple(one for site in hands for one in felt(loop, site, of)),
        clamped_verdict=spectrum(loaded(loop, {of: CLAMPED}), 1).verdict,
    )


def _slave(scenario: Scenario) -> str:
    return next((name for name, site in scenario.sites.items() if site.role == "slave"), scenario.names[-1])


def _proof(now: Conditions, loop: Loop, w_rad_s: Array) -> Passivity | None:
    output = proof_output(now, loop)
    beta = np.repeat(proof_weights(now), [len(ports_of(loop, site)) for site in sites(loop)])
    if output is None or not (beta > 0.0).all():
        return None
    return passivity(lambda w: transfer(loop, on_axis(w), output), w_rad_s, beta)


def _two_ports(loop: Loop, Y: Response, w_rad_s: Array) -> tuple[TwoPort, ...]:
    found = []
    for pair in combinations(sites(loop), 2):
        others = [site for site in sites(loop) if site not in pair]
        for clamped in ("", *others) if len(others) == 1 else ("",):
            places = ports_of(loop, clamped) if clamped else []
            for joint, keep in axes(loop).items():
                kept = [port for port in keep if site_of(loop.inputs[port]) in pair]
                found.append(TwoPort(pair, joint, clamped, _llewellyn(Y, kept, places, w_rad_s)))
    return tuple(found)


def _llewellyn(Y: Response, keep: list[int], clamped: list[int], w_rad_s: Array) -> Dips:
    def left(w: Array) -> Complex:
        return left_at(Y(w), keep, clamped)

    return dips(
        lambda w: llewellyn(left(w)), w_rad_s, level=1.0, tolerance=lambda w: llewellyn_rounding(left(w))
    )
