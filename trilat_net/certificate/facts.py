"""A certificate in numbers, for programs: what `trilat certify --json` prints and `summary.json` holds.

Law: keys end in their unit; what a log does not tell is null.
"""

import math
from typing import Any

import numpy as np

from ..core.arm import Array
from .balance import Balance
from .certificate import Certificate
from .premises import unjudged_spans
from .verdict import Rise

Facts = dict[str, Any]


def facts(certificate: Certificate) -> Facts:
    """Returns a certificate, ready for JSON."""
    verdict, grown = certificate.verdict, certificate.growth
    return {
        "passed": certificate.passed,
        "verdict": verdict.finding.name.lower(),
        "text": verdict.text,
        "rise": None if verdict.rise is None else _rise(verdict.rise),
        "tolerance_j": verdict.tolerance,
        "closed_groups": [list(group) for group in certificate.groups],
        "premises": [premise._asdict() for premise in certificate.premises],
        "growth": {
            "motion": grown.motion.name.lower(),
            "text": grown.text,
            "error_rate_per_s": _known(grown.end.error.rate_per_s),
            "speed_rate_per_s": _known(grown.end.speed.rate_per_s),
            "end_error_rad": grown.end.end_error_rad,
            "end_speed_rad_s": grown.end.end_speed_rad_s,
        },
        "functional": None if certificate.balance is None else _functional(certificate, certificate.balance),
    }


def _rise(rise: Rise) -> Facts:
    return {"from_s": rise.from_s, "at_s": rise.at_s, "amount_j": rise.amount, "causes_j": rise.causes}


def _ones(certificate: Certificate) -> Facts | None:
    if certificate.ones is None:
        return None
    rise, V = certificate.ones_rise, certificate.ones.V
    return {
        "v_first_j": float(V[0]),
        "v_max_j": float(V.max()),
        "rise": None if rise is None else _rise(rise),
    }


def _functional(certificate: Certificate, balance: Balance) -> Facts:
    V, sites = balance.V, certificate.books
    return {
        "beta_first": dict(zip(sites, balance.beta[0].tolist(), strict=True)),
        "beta_last": dict(zip(sites, balance.beta[-1].tolist(), strict=True)),
        "v_first_j": float(V[0]),
        "v_last_j": float(V[-1]),
        "v_max_j": float(V.max()),
        "parts_last_j": _last(balance.parts),
        "taken_j": _last(balance.taken),
        "given_j": _last(balance.given),
        "sampling_j": float(balance.sampling[-1]),
        "passed_on_j": float(balance.passed[-1]),
        "scale_j": balance.scale,
        "residual_max_j": _largest(balance.residual),
        "unexplained_max_j": _largest(balance.unexplained),
        "sites_unexplained_max_j": {site: _largest(book.unexplained) for site, book in sites.items()},
        "not_judged_s": unjudged_spans(balance),
        "ones": _ones(certificate),
    }


def _last(columns: dict[str, Array]) -> dict[str, float]:
    return {name: float(values[-1]) for name, values in columns.items()}


def _largest(values: Array) -> float:
    return float(np.abs(values).max())


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value
