"""Links whose delays vary in every way: in order, with play-out, over time, in bursts and with copies."""

from typing import Any

VARYING_LINKS: tuple[dict[str, Any], ...] = (
    {
        "link.model": "uniform",
        "link.delay_ms": 40.0,
        "link.half_width_ms": 40.0,
        "link.order": "in_order",
    },
    {
        "link.model": "normal",
        "link.delay_ms": 30.0,
        "link.deviation_ms": 20.0,
        "link.playout_ms": 60.0,
    },
    {
        "link.model": "sine",
        "link.delay_ms": 50.0,
        "link.amplitude_ms": 50.0,
        "link.period_s": 0.3,
    },
    {"link.preset": "4g", "link.duplicate": 0.2},
)
"""Overrides of a scenario, one set for each kind of variation."""

LINKS: tuple[dict[str, Any], ...] = (
    {"link.delay_ms": 0.0},
    {"link.delay_ms": 33.3},
    {"link.delay_ms": 150.0, "link.loss": 0.2},
    {"link.model": "uniform", "link.delay_ms": 40.0, "link.half_width_ms": 40.0},
    *VARYING_LINKS,
)
"""Links with constant, lossy and varying delays."""
