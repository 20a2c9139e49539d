"""A figure as a file.

Law: the same figure gives the same bytes: no date is in a file, and fonts are whole glyphs (TrueType).
"""

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

FORMATS = ("pdf", "png", "svg")

_RC: Any = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "trilat-net"}
_UNDATED: dict[str, dict[str, Any]] = {"pdf": {"CreationDate": None}, "png": {}, "svg": {"Date": None}}


def write(drawn: Figure, path: Path, dpi: int) -> None:
    """Writes a figure; the suffix says how: one of `FORMATS`.

    Args:
        drawn: the figure.
        path: where to.
        dpi: dots per inch of a .png.
    """
    kind = path.suffix.removeprefix(".").lower()
    with mpl.rc_context(_RC):
        drawn.savefig(path, format=kind, dpi=dpi, metadata=_UNDATED[kind])
