"""A port analysis as terminal text.

Invariant: every result carries its number, unit and frequency; the frequency grid is called evidence, no
proof.
"""

import math

import numpy as np

from ..theory.frequency_search import FrequencyBand
from ..theory.port_analysis import PortAnalysis, TwoPort
from ..theory.port_passivity import Passivity
from ..theory.port_transparency import QUOTED_AT_HZ, Transparency

_SHOWN_BANDS = 3
_JOINTS_BY_LINE = 2
WEIGHTS_ALIKE = 1e-9


def describe_ports(ports: PortAnalysis) -> list[str]:
    """Returns a port analysis as lines."""
    low, high = ports.band_hz
    lines = [
        f"Ports of {', '.join(ports.sites)}, operators and environments off, {low:g}-{high:g} Hz "
        "(a grid refined at minima: evidence, no proof)"
    ]
    if ports.resolved_hz < high:
        beyond = f"above {ports.resolved_hz:.3g} Hz"
        lines.append(f"  {beyond} the grid does not follow the phase of the longest delay")
    if ports.verdict == "unstable":
        return [*lines, "  the loop without operators is unstable: not passive, and without an impedance"]
    if ports.pole.order:
        kind = "as of free masses" if ports.pole.passive else "which no passive network has"
        lines.append(f"  at zero frequency Y has a pole of order {ports.pole.order}, {kind}")
    unit, kind = ports.impedance_unit(), ports.kind
    whole = _describe_passivity(ports.velocity, unit, kind)
    lines.append(f"  operators passive in {ports.speed}, coupled or not: {whole}")
    for joint, one in ports.joints.items():
        alone = _describe_passivity(one, ports.impedance_unit(joint), kind)
        lines.append(f"    {ports.name_port(joint)} alone: {alone}")
    if ports.proof is not None:
        proof = _describe_proof(ports, ports.proof)
        lines.append(f"  operators passive in r = {ports.speed} + Lambda e, the proof's premise: {proof}")
    absolute = _describe_absolute_stability(ports)
    lines.append(f"  a passive operator in {ports.speed} per site, best weights: {absolute}")
    lines += [f"    Llewellyn, {text}" for text in _describe_two_ports(ports)]
    if ports.clamped_verdict == "unstable":
        clamped = ports.transparency[0].of
        return [*lines, f"  with {clamped} clamped the loop is unstable: it has no steady impedance"]
    return [*lines, *(f"  {_describe_transparency(ports, one)}" for one in ports.transparency)]


def _describe_proof(ports: PortAnalysis, proof: Passivity) -> str:
    beta = ", ".join(f"{weight:.3g}" for weight in ports.beta)
    text = f"{_describe_passivity(proof)}; sites weighted {beta}"
    if np.ptp(ports.beta) > WEIGHTS_ALIKE:
        text += ", which is nothing for operators coupled to one another"
    if proof.passive or ports.estimates_true:
        return text
    return f"{text}; estimates here are not true, and the proof counts the energy that they store"


def _describe_passivity(one: Passivity, unit: str = "", kind: str = "") -> str:
    """Returns a passivity in words; with a unit, also the damping that each joint or axis lacks."""
    if one.passive:
        return "passive"
    minima = one.minima
    least = f"least eigenvalue {minima.least:.3g} at {minima.least_hz:.3g} Hz"
    text = f"not passive {_list_bands(minima.below)}; {least}"
    if not unit:
        return text
    if math.isinf(one.lacking_nm_s_rad):
        return f"{text}; no damping at the {'axes' if kind == 'axis' else 'joints'} would make it so"
    return f"{text}; {one.lacking_nm_s_rad:.3g} {unit} more at each {kind} would make it so"


def _list_bands(bands: tuple[FrequencyBand, ...]) -> str:
    shown = [f"{band.from_hz:.3g}-{band.to_hz:.3g}" for band in bands[:_SHOWN_BANDS]]
    more = f" and {len(bands) - _SHOWN_BANDS} ranges more" if len(bands) > _SHOWN_BANDS else ""
    return f"at {', '.join(shown)} Hz{more}"


def _describe_absolute_stability(ports: PortAnalysis) -> str:
    minima = ports.absolute
    if not minima.below:
        return "stable"
    can = "some make" if len(ports.sites) <= 3 else "some may make"
    margin = f"margin {minima.least:.3g} at {minima.least_hz:.3g} Hz"
    return f"{can} it unstable {_list_bands(minima.below)}; {margin}"


def _describe_two_ports(ports: PortAnalysis) -> list[str]:
    """Returns the two-ports that fail the criterion, and the number of those that meet it."""
    failing = [one for one in ports.two_ports if one.minima.below]
    holding = len(ports.two_ports) - len(failing)
    third = ", the third site free or clamped" if any(one.clamped for one in ports.two_ports) else ""
    every = f"every pair and {ports.kind}{third}" if not failing else "the others"
    groups: dict[tuple[object, ...], list[TwoPort]] = {}
    for one in failing:  # of arms of many joints those of one pair share a line
        joint = one.joint if len(ports.joints) <= _JOINTS_BY_LINE else ""
        groups.setdefault((one.sites, one.clamped, joint), []).append(one)
    lines = []
    for group in groups.values():
        worst = min(group, key=lambda one: one.minima.least)
        sites, _, clamped, minima = worst
        joints, bands = (
            ", ".join(str(ports.axes.get(one.joint, one.joint)) for one in group),
            [b for one in group for b in one.minima.below],
        )
        within = f"within {min(b.from_hz for b in bands):.3g}-{max(b.to_hz for b in bands):.3g} Hz"
        which = f"{' and '.join(sites)}{f', {clamped} clamped' if clamped else ''}, {ports.kind} {joints}"
        least = f"least {minima.least:.3g} at {minima.least_hz:.3g} Hz"
        lines.append(f"{which}: fails {_list_bands(minima.below) if len(group) == 1 else within}; {least}")
    return [*lines, *([f"{every}: holds ({holding} two-ports)"] if holding else [])]


def _describe_transparency(ports: PortAnalysis, one: Transparency) -> str:
    unit = ports.impedance_unit(one.joint)
    free, clamped = one.size_at(QUOTED_AT_HZ)
    low, high = one.band_hz
    return (
        f"{one.at} feels of {one.of}, {ports.name_port(one.joint)}: {free:.4g} {unit} free and {clamped:.4g} "
        f"clamped at {QUOTED_AT_HZ:g} Hz; over {low:g}-{high:g} Hz the ratio is {one.ratio_db:.3g} dB, the "
        f"difference {one.difference_nm_s_rad:.3g} {unit}"
    )
