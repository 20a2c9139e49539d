"""What is said of the ports, in words for people and as facts for programs.

Law: every answer stands with its number, its unit and its frequency; the grid is called evidence, no proof.
"""

import math
from typing import Any

from .curve import Dips, Span
from .passivity import Passivity
from .section import PortSection, TwoPort
from .transparency import Felt

_AT_HZ = 1.0
_MOST_SPANS = 3


def port_lines(section: PortSection) -> list[str]:
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


def _proof(section: PortSection, one: Passivity) -> str:
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


def _spans(spans: tuple[Span, ...]) -> str:
    said = [f"{span.from_hz:.3g}-{span.to_hz:.3g}" for span in spans[:_MOST_SPANS]]
    more = f" and {len(spans) - _MOST_SPANS} ranges more" if len(spans) > _MOST_SPANS else ""
    return f"at {', '.join(said)} Hz{more}"


def _absolute(section: PortSection) -> str:
    dips = section.absolute
    if not dips.below:
        return "stable"
    can = "some make" if len(section.sites) <= 3 else "some may make"
    return f"{can} it unstable {_spans(dips.below)}; margin {dips.least:.3g} at {dips.least_hz:.3g} Hz"


def _two_ports(section: PortSection) -> list[str]:
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


def _felt(one: Felt) -> str:
    free, clamped = one.size_at(_AT_HZ)
    low, high = one.band_hz
    return (
        f"{one.at} feels of {one.of}, joint {one.joint}: {free:.4g} N m s/rad free and {clamped:.4g} "
        f"clamped at {_AT_HZ:g} Hz; Z-width {one.width_db:.3g} dB over {low:g}-{high:g} Hz"
    )


def port_facts(section: PortSection) -> dict[str, Any]:
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


def _dips_facts(one: Dips) -> dict[str, Any]:
    return {
        "holds": not one.below,
        "least": one.least,
        "least_hz": one.least_hz,
        "fails_hz": [list(span) for span in one.below],
    }


def _felt_facts(one: Felt) -> dict[str, Any]:
    free, clamped = one.size_at(_AT_HZ)
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
