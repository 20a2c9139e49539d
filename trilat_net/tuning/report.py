"""Writes a comparison into a folder: front.json, front.md, front.png and front.pdf.

Law: the JSON is the result; the others are views of it.
"""

import json
from pathlib import Path

from ..analysis import style
from .facts import facts
from .figure import front_figure
from .tables import page
from .tuning import Tuned


def write(tuned: Tuned, folder: Path) -> list[Path]:
    """Writes a comparison into a folder that exists, and returns the paths."""
    data, text = folder / "front.json", folder / "front.md"
    data.write_text(json.dumps(facts(tuned), indent=2, ensure_ascii=False, allow_nan=False) + "\n", "utf-8")
    text.write_text(page(tuned), "utf-8")
    figure = front_figure(tuned)
    pictures = [folder / "front.png", folder / "front.pdf"]
    for path in pictures:
        figure.savefig(path, dpi=style.DPI)
    return [data, text, *pictures]
