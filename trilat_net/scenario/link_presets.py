"""Link presets: settings of typical networks that a scenario can select by name.

A preset such as "4g" stands for a delay model and its keys.

Invariant:
    - A preset contains nothing that an author could not write in a scenario. The presets and
      their sources are in the file `scenarios/_presets.toml`.
"""

import tomllib
from typing import Any

from .named_files import SHIPPED_FOLDER

PRESETS_FILE = SHIPPED_FOLDER / "_presets.toml"

GRID_ROUND_TRIPS_MS = (8, 68, 136, 272, 544, 1088)
GRID_LOSSES_PERCENT = (0, 10, 25, 50)
"""Losses in the grid of presets, in percent. See `GRID_ROUND_TRIPS_MS` for the round trips.

The ranges are taken from Rodriguez-Seda, Lee and Spong, "Experimental Comparison Study of
Control Architectures for Bilateral Teleoperators", IEEE Trans. Robotics 25 (2009): round trips
of 8 to 1088 ms and losses of 0 to 50 %. The grid points are our own choice, since those of the
study are not known.
"""

_GRID: dict[str, dict[str, Any]] = {
    f"rtt{rtt_ms}-loss{percent}": {
        "model": "constant",
        "delay_ms": rtt_ms / 2,
        "loss": percent / 100,
    }
    for rtt_ms in GRID_ROUND_TRIPS_MS
    for percent in GRID_LOSSES_PERCENT
}
PRESETS: dict[str, dict[str, Any]] = {
    **tomllib.loads(PRESETS_FILE.read_text(encoding="utf-8")),
    **_GRID,
}
"""Mapping from preset name to the link keys that it stands for.

Presets of the grid, such as `rtt68-loss10`, delay each direction by half of the round trip and
lose samples independently.
"""
