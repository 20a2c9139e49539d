"""The check of whole pages finds what it is for: each fault of a page, and none of a page without a fault."""

from pathlib import Path

from playwright.sync_api import Browser

from tests.live.browsers import needs_browser
from trilat_net import presentation

from .whole_pages import watched_page

pytestmark = needs_browser

LIBRARY = Path(presentation.__file__).with_name("assets") / "uPlot.iife.min.js"
CHART = """<figure id="frame"><h2>ages</h2></figure><script>{library}</script><script>
const lines = [{{ label: "a", stroke: "red" }},
  {{ label: "b", stroke: "blue", points: {{ show: {points} }} }}];
new uPlot({{ width: 300, height: 200, series: [{{}}, ...lines],
  scales: {{ x: {{ time: false }}, y: {{ range: [0, 5] }} }} }},
  [[0, 1, 2], [1, 2, 3], {values}], document.getElementById("frame"));</script>"""
PAINTED = """<canvas id="c"></canvas><script>
const g = document.getElementById("c").getContext("2d"); g.fillRect(3, 3, 20, 20);</script>"""
PARSED = """<script>const sent = JSON.parse('{"charts": [{"x": 1}]}');
sent.charts.map((chart) => chart.points);</script>"""
FAULTS = {
    "<script>nothing.here</script>": "nothing is not defined",
    "<script>console.error('wrong')</script>": "console: wrong",
    "<img src='missing.png' alt='map'>": "not loaded",
    "<canvas aria-label='links'></canvas>": "nothing is drawn in canvas (links)",
    "<svg aria-label='arm' width='50' height='50'><polyline points='' stroke='red'/></svg>": "svg (arm)",
    "<svg aria-label='arm' width='50' height='50'><line x1='90' x2='99' stroke='red'/></svg>": "svg (arm)",
    "<figure><figcaption>torques</figcaption><div></div></figure>": "nothing is drawn in figure (torques)",
    "<div data-section='delays'>.</div>": "nothing is drawn in div",
    "<table aria-label='loops'><tr><th>site</th></tr></table>": "nothing is drawn in table (loops)",
    CHART.format(
        library="LIBRARY", values="[null, null, null]", points="false"
    ): "line 2 (b) of",
    CHART.format(library="LIBRARY", values="[1, null, 3]", points="false"): "line 2 (b) of",
    CHART.format(library="LIBRARY", values="[7, 8, 9]", points="false"): "line 2 (b) of",
    PARSED: "a script reads charts[].points, which nobody has sent",
}
"""Pages with one fault each, and words of what is said of it."""
WHOLE = {
    "text": "<p>a page without frames</p>",
    "canvas": PAINTED,
    "shapes": "<svg width='50' height='50'><polyline points='1,1 9,9' stroke='red'/></svg>",
    "chart": CHART.format(library="LIBRARY", values="[2, 2, 2]", points="false"),
    "lines over each other": CHART.format(
        library="LIBRARY", values="[1, 2, 3]", points="false"
    ),
    "points": CHART.format(library="LIBRARY", values="[1, null, 3]", points="true"),
    "hidden": "<canvas hidden></canvas><figure style='display: none'></figure>",
    "field with a question": PARSED.replace("chart.points", '"points" in chart'),
}


def find_faults(browser: Browser, body: str, folder: Path) -> list[str]:
    """Returns what is wrong with a page of a body."""
    file = folder / "page.html"
    html = f"<!DOCTYPE html><meta charset=utf-8>{body}"
    file.write_text(
        html.replace("LIBRARY", LIBRARY.read_text(encoding="utf-8")), encoding="utf-8"
    )
    with watched_page(browser) as watched:
        watched.page.goto(file.as_uri())
        faults = watched.find_faults()
        watched.errors.clear()
    return faults


def test_each_fault_of_a_page_is_found(browser: Browser, tmp_path: Path) -> None:
    for body, phrase in FAULTS.items():
        faults = find_faults(browser, body, tmp_path)
        assert any(phrase in fault for fault in faults), (body, faults)


def test_a_page_without_fault_is_whole(browser: Browser, tmp_path: Path) -> None:
    for name, body in WHOLE.items():
        assert find_faults(browser, body, tmp_path) == [], name
