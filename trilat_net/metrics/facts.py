"""The quantities of a log for programs: what `trilat metrics --json` prints.

Law: keys end in their unit and are always there; what a log does not tell is null, and `unknown` says why.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..log.reader import Log
from .measurement import Measurement
from .said import Facts
from .sharing import Lever, Shared

VERSION = 1
"""Of this layout: keys may be added under it, none is taken away or changes its meaning."""


def facts(log: Log, measured: Measurement) -> dict[str, Any]:
    """Returns the quantities of a log, ready for JSON.

    Args:
        log: the log.
        measured: what was measured of it.
    """
    places: dict[str, Mapping[str, Facts]] = {
        "sites": measured.sites,
        "links": measured.links,
        "walls": measured.walls,
    }
    found: dict[str, Any] = {
        "version": VERSION,
        "log": Path(log.source).name,
        "scenario": log.scenario.name,
        "driver": log.driver,
        "complete": log.complete,
        "run": _values(measured.run),
        **{kind: {name: _values(one) for name, one in found.items()} for kind, found in places.items()},
        "parameters": {site: learnt._asdict() for site, learnt in measured.learnt.items()},
        "windows_at_rest": None if measured.rest.value is None else int(measured.rest.value),
        "levers": [_lever(lever) for lever in measured.levers],
        "force_sharing": [_shared(pair) for pair in measured.shared],
        "stiffness": [one._asdict() for one in measured.stiffness],
        "felt": [
            {
                **one._asdict(),
                "ratio": {**one.ratio._asdict(), "why": one.ratio.why or None, "unit": one.unit},
            }
            for one in measured.felt
        ],
        "unknown": {
            **_whys("run", measured.run),
            **{
                path: why
                for kind, found in places.items()
                for name, one in found.items()
                for path, why in _whys(f"{kind}.{name}", one).items()
            },
            **_whys("", {"windows_at_rest": measured.rest}),
        },
    }
    return {key: _finite(value) for key, value in found.items()}


def _finite(value: Any) -> Any:
    """Returns a value with null for every number that is not finite, as of logs that left the physics."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    return [_finite(one) for one in value] if isinstance(value, list | tuple) else value


def _values(found: Facts) -> dict[str, float | None]:
    return {key: one.value for key, one in found.items()}


def _whys(path: str, found: Facts) -> dict[str, str]:
    """Returns why there are no numbers, by their paths."""
    start = f"{path}." if path else ""
    return {f"{start}{key}": one.why for key, one in found.items() if one.value is None}


def _lever(lever: Lever) -> dict[str, Any]:
    weights = {site: one.value for site, one in lever.weight.items()}
    why = lever.imbalance.why or None
    return {**lever._asdict(), "weight": weights, "imbalance": lever.imbalance.value, "why": why}


def _shared(pair: Shared) -> dict[str, Any]:
    expected = pair.expected_nm
    return {
        **pair._asdict(),
        "expected_nm": expected.value,
        "off": pair.off,
        "why": expected.why or None,
    }
