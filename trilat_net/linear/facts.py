"""An analysis for a machine.

Law: every number of the words is in here, with more digits and its unit in its key.
"""

from typing import Any

from .analysis import Analysis
from .margin import Crossing
from .spectrum import Root, Spectrum


def facts(found: Analysis) -> dict[str, Any]:
    """Returns all of an analysis as plain values."""
    return {
        "scenario": found.scenario.name,
        "scenario_sha256": found.scenario.sha256,
        "verdict": found.verdict,
        "rest": {
            "how": found.rest.how,
            "residual": found.rest.residual,
            "q_rad": dict(zip(found.scenario.names, found.rest.q.tolist(), strict=True)),
            "theta_hat": dict(zip(found.scenario.names, found.rest.theta_hat.tolist(), strict=True)),
        },
        "delay_in_use_ms": _ages(found),
        "continuous": _spectrum(found.continuous),
        "as_computed": None if found.sampled is None else _spectrum(found.sampled),
        "margin": {
            "words": found.margin.words,
            "stable": [{"from_s": span.low_s, "to_s": span.high_s} for span in found.margin.spans],
            "crossings": [_crossing(one) for one in found.margin.crossings],
        },
        "notes": list(found.notes),
    }


def _ages(found: Analysis) -> dict[str, float]:
    names, alpha, age_s = found.scenario.names, found.now.alpha, found.now.age_s
    return {
        f"{names[j]}->{names[i]}": 1e3 * float(age_s[i, j])
        for i in range(len(names))
        for j in range(len(names))
        if alpha[i, j]
    }


def _spectrum(found: Spectrum) -> dict[str, Any]:
    return {
        "verdict": found.verdict,
        "roots": [_root(root) for root in found.roots],
        "zeros_by_structure": found.zeros,
        "of_those_drifting": found.drifting,
        "dropped_candidates": found.dropped,
        "order": found.order,
    }


def _root(root: Root) -> dict[str, Any]:
    return {
        "re_per_s": root.re_per_s,
        "im_rad_s": root.im_rad_s,
        "damping": root.damping,
        "modes": root.multiplicity,
        "states": list(root.states),
    }


def _crossing(one: Crossing) -> dict[str, Any]:
    return {"delay_s": one.delay_s, "omega_rad_s": one.omega_rad_s, "pairs_to_the_right": one.pairs}
