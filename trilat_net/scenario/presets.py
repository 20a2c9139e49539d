"""Named links; `scenarios/_presets.toml` has them, each with its source.

Law: a preset is what an author could have written; a resolved scenario holds its keys, not its name.
"""

import tomllib
from importlib import resources
from typing import Any

_FILE = resources.files("trilat_net") / "scenarios" / "_presets.toml"

GRID_ROUND_TRIPS_MS = (8, 68, 136, 272, 544, 1088)
GRID_LOSSES_PERCENT = (0, 10, 25, 50)
"""A grid over the ranges of Rodriguez-Seda, Lee and Spong, "Experimental Comparison Study of Control
Architectures for Bilateral Teleoperators", IEEE Trans. Robotics 25 (2009): round trips of 8 to 1088 ms
and losses of 0 to 50 %. The points are ours; theirs are not known to us."""


def _grid() -> dict[str, dict[str, Any]]:
    """Returns the presets of the grid: half a round trip each way, every sample lost by itself."""
    return {
        f"rtt{round_trip_ms}-loss{percent}": {
            "model": "constant",
            "delay_ms": round_trip_ms / 2,
            "loss": percent / 100,
        }
        for round_trip_ms in GRID_ROUND_TRIPS_MS
        for percent in GRID_LOSSES_PERCENT
    }


PRESETS: dict[str, dict[str, Any]] = {**tomllib.loads(_FILE.read_text(encoding="utf-8")), **_grid()}
"""Keys of a link by the preset's name."""
