"""A port analysis as terminal text.

Invariant: every result carries its number, unit and frequency; the frequency grid is called evidence, no
proof.
"""

import math

from ..theory.frequency_search import FrequencyBand
from ..theory.port_analysis import PortAnalysis, TwoPort
from ..theory.port_passivity import Passivity
from ..theory.port_transparency import QUOTED_AT_HZ, Transparency

_MOST_SPANS = 3


def describe_ports(section: PortAnalysis) -> list[str]:
    """Returns the section as lines.

    Args:
        section: what there is to say.
    """
    low, high = section.band_hz
    lines = [
        f"Ports of {', '.join(section.sites)}, hands and environments off, {low:g}-{high:g} Hz "
        "(a grid refined at dips: evidence, no proof)"
    ]
    if section.resolved_hz < high:
        lines.append(
            f"  above {section.resolved_hz:.3g} Hz the grid does not follow the phase of the longest delay"
        )
    if section.verdict == "unstable":
        return [*lines, "  the loop without hands is unstable: it is neither passive nor has it an impedance"]
    if section.pole.order:
        kind = "as that of masses adrift" if section.pole.passive else "which no passive network has"
        lines.append(f"  at zero frequency Y has a pole of order {section.pole.order}, {kind}")
    lines.append(f"  hands passive in qd: {_passive(section.velocity)}")
    lines += [f"    joint {joint} alone: {_passive(one)}" for joint, one in section.joints.items()]
    if section.proof is not None:
        lines.append(
            f"  hands passive in r = qd + Lambda e, as the proof asks: {_proof(section, section.proof)}"
        )
    lines.append(f"  any passive hands in qd, best weights: {_absolute(section)}")
    lines += [f"    Llewellyn, {text}" for text in _two_ports(section)]
    if section.clamped_verdict == "unstable":
        lines.append(
            f"  with {section.felt[0].of} clamped the loop is unstable: nothing steady is felt of it"
        )
        return lines
    return [*lines, *(f"  {_felt(one)}" for one in section.felt)]


def _proof(section: PortAnalysis, one: Passivity) -> str:
    beta = ", ".join(f"{weight:.3g}" for weight in section.beta)
    said = f"{_passive(one, damping=False)}; sites weighted {beta}"
    if one.passive or section.true:
        return said
    return f"{said}; estimates here are not the truth, and what they store the proof counts and this does not"


def _passive(one: Passivity, *, damping: bool = True) -> str:
    if one.passive:
        return "passive"
    dips = one.dips
    least = f"not passive {_spans(dips.below)}; least eigenvalue {dips.least:.3g} at {dips.least_hz:.3g} Hz"
    if not damping:
        return least
    if math.isinf(one.lacking_nm_s_rad):
        return f"{least}; no damping at the joints would make it so"
    return f"{least}; {one.lacking_nm_s_rad:.3g} N m s/rad more at each joint would make it so"


def _spans(spans: tuple[FrequencyBand, ...]) -> str:
    said = [f"{span.from_hz:.3g}-{span.to_hz:.3g}" for span in spans[:_MOST_SPANS]]
    more = f" and {len(spans) - _MOST_SPANS} ranges more" if len(spans) > _MOST_SPANS else ""
    return f"at {', '.join(said)} Hz{more}"


def _absolute(section: PortAnalysis) -> str:
    dips = section.absolute
    if not dips.below:
        return "stable"
    can = "some make" if len(section.sites) <= 3 else "some may make"
    return f"{can} it unstable {_spans(dips.below)}; margin {dips.least:.3g} at {dips.least_hz:.3g} Hz"


def _two_ports(section: PortAnalysis) -> list[str]:
    """Returns where it fails, and for how many it holds."""
    failing = [one for one in section.two_ports if one.dips.below]
    holding = len(section.two_ports) - len(failing)
    third = ", the third site free or clamped" if any(one.clamped for one in section.two_ports) else ""
    every = f"every pair and joint{third}" if not failing else "the others"
    counted = [f"{every}: holds ({holding} two-ports)"] if holding else []
    return [*map(_two_port, failing), *counted]


def _two_port(one: TwoPort) -> str:
    third = f", {one.clamped} clamped" if one.clamped else ""
    where = f"{one.sites[0]} and {one.sites[1]}{third}, joint {one.joint}"
    return (
        f"{where}: fails {_spans(one.dips.below)}; least {one.dips.least:.3g} at {one.dips.least_hz:.3g} Hz"
    )


def _felt(one: Transparency) -> str:
    free, clamped = one.size_at(QUOTED_AT_HZ)
    low, high = one.band_hz
    return (
        f"{one.at} feels of {one.of}, joint {one.joint}: {free:.4g} N m s/rad free and {clamped:.4g} "
        f"clamped at {QUOTED_AT_HZ:g} Hz; Z-width {one.width_db:.3g} dB over {low:g}-{high:g} Hz"
    )
