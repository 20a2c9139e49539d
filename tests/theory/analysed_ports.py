"""Ports of shipped scenarios and of hand-made networks, analysed."""

from functools import cache
from typing import Any

from tests.theory.networks import Network
from trilat_net.analysis.theory.equilibrium import find_equilibrium
from trilat_net.analysis.theory.frequency_search import Minima, build_frequency_grid
from trilat_net.analysis.theory.port_analysis import PortAnalysis
from trilat_net.analysis.theory.port_passivity import llewellyn_parameter, llewellyn_rounding
from trilat_net.analysis.theory.port_response import build_admittance
from trilat_net.scenario import load_scenario

POSE = (-0.6, 1.8)


@cache
def section_of(
    name: str, overrides: tuple[tuple[str, Any], ...] = (), of: str | None = None
) -> PortAnalysis:
    """Returns the analysis of the ports of a shipped scenario about POSE; () is an empty list."""
    scenario = load_scenario(
        name, {key: [] if value == () else value for key, value in overrides}
    )
    return PortAnalysis.of_scenario(scenario, find_equilibrium(scenario, POSE), of)


def find_failing_frequencies(network: Network) -> Minima:
    """Returns the frequencies at which the two ports of a network fail Llewellyn's criterion."""
    Y = build_admittance(network.loop)
    return Minima.find(
        lambda w: llewellyn_parameter(Y(w)),
        build_frequency_grid(1e-3, 100.0, 0.2),
        level=1.0,
        tolerance=lambda w: llewellyn_rounding(Y(w)),
    )
