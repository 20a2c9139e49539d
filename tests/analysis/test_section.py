"""Parts of the report that are made elsewhere."""

import base64
import re
from pathlib import Path

from trilat_net.reporting.page import ReportSection, render_sections, write_section_figures
from trilat_net.reporting.style import empty_figure


def test_a_section_is_in_the_page_with_its_figure_and_its_heading_escaped() -> None:
    html = render_sections(
        [
            ReportSection("one", "<b>", "<p>text</p>", {}, empty_figure("a figure")),
            ReportSection("two", "2", "", {}),
        ]
    )
    assert "<h2>&lt;b&gt;</h2><p>text</p>" in html
    (data,) = re.findall(r"data:image/png;base64,([^\"]+)", html)
    assert base64.b64decode(data).startswith(b"\x89PNG")


def test_figures_are_written_beside_the_page(tmp_path: Path) -> None:
    paths = write_section_figures(
        [ReportSection("one", "", "", {}, empty_figure("a figure")), ReportSection("two", "", "", {})],
        tmp_path,
    )
    assert [path.name for path in paths] == ["one.png"]
    assert paths[0].read_bytes().startswith(b"\x89PNG")
