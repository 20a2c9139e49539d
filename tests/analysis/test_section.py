"""Parts of the report that are made elsewhere."""

import base64
import re
from pathlib import Path

from trilat_net.analysis.section import Section, sections_html, write_sections
from trilat_net.analysis.style import says


def test_a_section_is_in_the_page_with_its_figure_and_its_heading_escaped() -> None:
    html = sections_html(
        [Section("one", "<b>", "<p>text</p>", {}, says("a figure")), Section("two", "2", "", {})]
    )
    assert "<h2>&lt;b&gt;</h2><p>text</p>" in html
    (data,) = re.findall(r"data:image/png;base64,([^\"]+)", html)
    assert base64.b64decode(data).startswith(b"\x89PNG")


def test_figures_are_written_beside_the_page(tmp_path: Path) -> None:
    paths = write_sections(
        [Section("one", "", "", {}, says("a figure")), Section("two", "", "", {})], tmp_path
    )
    assert [path.name for path in paths] == ["one.png"]
    assert paths[0].read_bytes().startswith(b"\x89PNG")
