"""A figure and an export format are one file each: the program finds a file that was put beside
the others.
"""

from pathlib import Path

import pytest

from tests.dropped_files import run_in_folder
from trilat_net.presentation.figures.figure_entry import draws
from trilat_net.presentation.figures.registry import FIGURES

FIGURE = """
import numpy as np

from trilat_net.presentation import style
from trilat_net.presentation.figures.figure_entry import draws


@draws("haste", "speeds over time", in_report=True)
def draw_haste(log, form):
    with style.time_figure(log, form, 2.0) as plot:
        (axes,) = style.add_panels(plot.figure, 1, 1)[:, 0]
        for site in log.sites:
            axes.plot(log[site].t_s, np.abs(log[site].qd).max(axis=1))
    return plot.figure
"""
FORMAT = """
from trilat_net.presentation.export import ExportFormat


def _write(log, path, written):
    path.write_text(" ".join(f"{site} {len(log[site])}" for site in log.sites))
    written(sum(len(log[site]) for site in log.sites))


FORMAT = ExportFormat(_write, ".counts")
"""
LOOK = """
import contextlib, io, json, os, sys
from pathlib import Path
os.environ["COLUMNS"] = "200"
import trilat_net.presentation.exports
import trilat_net.presentation.figures
for room in (trilat_net.presentation.exports, trilat_net.presentation.figures):
    room.__path__.append(sys.argv[1] + "/" + room.__name__.rsplit(".", 1)[1])
import trilat_net as tn
from trilat_net.app.cli import app
from trilat_net.app.cli.options import complete_figures

def run(*words):
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        app(words, standalone_mode=False)
    return said.getvalue()

path = tn.simulate("two_sites", {"duration_s": 0.1}).save("run.mcap")
tn.report(path, "report", png=True)
figures = json.loads(run("figure", str(path), "--list", "--json"))
run("figure", str(path), "haste", "--format", "svg")
print(json.dumps({
    "figures": [row["name"] for row in figures],
    "completed": complete_figures("ha"),
    "drawn": [str(one) for one in sorted(Path().rglob("haste.*")) if one.suffix in (".svg", ".png")],
    "told": json.loads(run("log", "export", str(path), "--to", "counts", "--json"))["file"],
    "asked": tn.export(path, "counts", "mine").read_text(),
    "help": run("log", "export", "--help"),
}))
"""


@pytest.mark.long
def test_added_files_are_figures_and_formats(tmp_path: Path) -> None:
    for name, text in {"figures/haste.py": FIGURE, "exports/counts.py": FORMAT}.items():
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(text)
    output = run_in_folder(LOOK, tmp_path)
    assert output["figures"][-1] == "haste"
    assert output["completed"] == ["hands_moved", "haste"]
    assert [Path(name).name for name in output["drawn"]] == ["haste.png", "haste.svg"]
    assert output["told"] == "run.counts"
    assert output["asked"] == "m 100 s 100"
    assert "counts" in output["help"]


def test_duplicate_figures_are_refused_with_both_files() -> None:
    with pytest.raises(
        ValueError, match=r"figure arms has two definitions, in .*arm_poses and .*run_overview"
    ):
        draws("arms", "again")(FIGURES["overview"].draw)
