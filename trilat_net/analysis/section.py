"""A part of the report that is made elsewhere: its words, its numbers, its figure.

Law: the page stays one file: a figure is in it, and beside it as PNG like every other.
"""

import base64
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from . import style

_PAGE_DPI = 110


class Section(NamedTuple):
    """A section of the page.

    Attributes:
        key: its name in `summary.json`, and of its figure's file.
        heading: in words.
        html: its body, with everything escaped that came from outside.
        facts: its numbers, ready for JSON.
        figure: what it shows; None: nothing.
    """

    key: str
    heading: str
    html: str
    facts: dict[str, Any]
    figure: Figure | None = None


def sections_html(sections: Sequence[Section]) -> str:
    """Returns the sections for the page, figures and all."""
    return "".join(
        f"<section><h2>{escape(one.heading)}</h2>{one.html}{_image(one)}</section>" for one in sections
    )


def write_sections(sections: Sequence[Section], folder: Path) -> list[Path]:
    """Writes the sections' figures as PNG into a folder that exists, and returns the paths."""
    paths = []
    for one in sections:
        if one.figure is not None:
            paths.append(folder / f"{one.key}.png")
            one.figure.savefig(paths[-1], dpi=style.DPI)
    return paths


def _image(section: Section) -> str:
    if section.figure is None:
        return ""
    stream = io.BytesIO()
    section.figure.savefig(stream, format="png", dpi=_PAGE_DPI)
    data = base64.b64encode(stream.getvalue()).decode()
    alt = escape(section.heading)
    return f'<img src="data:image/png;base64,{data}" alt="{alt}" style="max-width:100%">'
