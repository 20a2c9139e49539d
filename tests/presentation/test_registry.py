"""Figures for papers: sizes, fonts, words, files.

Their content is tested beside the functions that draw them.
"""

import re
from functools import cache

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.text import Text

import trilat_net
from tests.analysis.builders import make_busy_run, make_short_log
from tests.log.builders import add_clock_readings
from tests.presentation.figure_content import list_misplaced
from trilat_net.errors import UsageError
from trilat_net.presentation.appearance import COLUMN_IN, PAGE_IN, FigureSize
from trilat_net.presentation.figures import age_and_lateness, joint_motion
from trilat_net.presentation.figures.registry import (
    FIGURES,
    figure,
    list_drawable_figures,
    write_figures,
)
from trilat_net.presentation.style import FIGURE_FORMATS, write_figure

UNIT = re.compile(r"\((s|rad|rad/s|m|mm|N|N m|kg m|kg m²|J|ms|µs|count|%|1)\)$")
WALLED = {"duration_s": 3.0, "rate_hz": 200, "link.delay_ms": 20}
"""Until the tip is in the wall."""


@cache
def simulate_walled():
    return trilat_net.simulate("contact", WALLED)


@cache
def make_example_log(name):
    """Returns a log that has data for a figure: changes and marks if possible."""
    if name in ("operation", "operator_torques", "hands_moved"):
        return make_short_log("paper")
    if name == "observed_energy":
        return trilat_net.simulate(
            "two_sites", {"control.law": "tanks", "scheme": "digital", "duration_s": 0.3}
        )
    return simulate_walled() if name == "contact" else add_clock_readings(make_busy_run().log)


@cache
def draw_example(name, width_in):
    return figure(make_example_log(name), name, width_in)


@pytest.mark.parametrize(
    ("name", "width_in"),
    [
        *(
            pytest.param(name, COLUMN_IN, marks=pytest.mark.long if n % 2 else ())
            for n, name in enumerate(FIGURES)
            if name != "paths"
        ),
        ("positions", PAGE_IN),
        ("certificate", PAGE_IN),
    ],
)
def test_words_have_8_pt_without_overlap(name, width_in):
    figure_drawn = draw_example(name, width_in)
    assert figure_drawn.get_figwidth() == width_in
    assert list_misplaced(figure_drawn) == []
    assert {
        text.get_fontsize() for text in figure_drawn.findobj(Text) if text.get_text().strip()
    } == {8.0}
    for axes in figure_drawn.axes:
        spec = axes.get_subplotspec()
        below_it_is_the_same = len(axes.get_shared_x_axes().get_siblings(axes)) > 1
        if spec.is_last_row() or not below_it_is_the_same:
            assert UNIT.search(axes.get_xlabel()), axes.get_xlabel()
        if spec.is_first_col():
            assert UNIT.search(axes.get_ylabel()), axes.get_ylabel()


@pytest.mark.parametrize("name", ["parameter_estimates", "contact"])
def test_pdf_figures_embed_fonts_without_date(name, tmp_path):
    """252 pt are 3.5 in; Type 42 is TrueType, which journals accept, unlike Type 3."""
    before = dict(mpl.rcParams)
    path = tmp_path / f"{name}.pdf"
    write_figure(draw_example(name, COLUMN_IN), path, FigureSize.for_print(COLUMN_IN).dpi)
    assert dict(mpl.rcParams) == before
    data = path.read_bytes()
    (box,) = re.findall(rb"/MediaBox \[ ?([\d. ]+) ?\]", data)
    left, bottom, right, top = map(float, box.split())
    assert (left, bottom, right) == (0.0, 0.0, pytest.approx(252.0))
    assert top == pytest.approx(72.0 * draw_example(name, COLUMN_IN).get_figheight())
    assert len(re.findall(rb"/Type /Page\b(?!s)", data)) == 1
    assert b"/Type3" not in data
    assert data.count(b"/Subtype /Type0") == data.count(b"/FontFile2") > 0
    assert b"CreationDate" not in data
    assert b"/Subtype /Image" not in data


@pytest.mark.parametrize("kind", FIGURE_FORMATS)
def test_the_same_log_gives_the_same_bytes(kind, tmp_path):
    first = tmp_path / f"a.{kind}"
    second = tmp_path / f"b.{kind}"
    for path in (first, second):
        write_figure(
            figure(simulate_walled(), "contact"), path, FigureSize.for_print(COLUMN_IN).dpi
        )
    assert first.read_bytes() == second.read_bytes()
    if kind == "png":
        assert int.from_bytes(first.read_bytes()[16:20], "big") == 2100  # 600 dots per inch


def test_logs_have_the_figures_they_support():
    have = set(list_drawable_figures(simulate_walled()))
    assert {"contact", "operation", "positions"} <= have
    assert (
        not {
            "authority",
            "certificate",
            "parameter_estimates",
            "loop_timing",
            "delay_distributions",
        }
        & have
    )
    assert "contact" not in list_drawable_figures(make_busy_run().log)
    reasons = {name: entry.absent(make_short_log("free")) for name, entry in FIGURES.items()}
    assert reasons["operator_torques"] == reasons["hands_moved"] == joint_motion.NO_OPERATOR
    assert reasons["loop_timing"] == age_and_lateness.NO_LOOP_CLOCK
    assert not reasons["positions"]
    assert {"authority", "delay_distributions"} <= set(
        list_drawable_figures(make_busy_run().log)
    )


def test_wall_force_equals_the_recorded_torque():
    """J'F of the drawn force along the normal is the recorded torque ON the arm, because no
    other force acts.
    """
    log = simulate_walled()
    part = log["s"]
    wall = log.scenario.sites["s"].environment[0]
    above = FIGURES["contact"].draw(log).axes[0]
    t_s, force = above.lines[0].get_data()
    rows = np.rint(t_s * part.rate_hz).astype(int)
    q = part.q[rows]
    outer = np.sin(q.sum(axis=1))
    into_x = np.stack([-np.sin(q[:, 0]) - outer, -outer], axis=1)  # d x_tip / d q, links of 1 m
    assert force.max() > 1.0
    assert -part.tau_x[rows] == pytest.approx(
        into_x * (wall.normal[0] * force)[:, None], abs=1e-9
    )


@pytest.mark.parametrize(
    ("names", "options", "said"),
    [
        (["setling"], {}, "did you mean 'settling'"),
        (["x"], {}, "the figures are overview, operation"),
        (["authority"], {}, "shares of all sites are constant"),
        (["contact"], {"width_in": 5.0}, "3.5 or 7 in"),
        (["contact"], {"formats": ["eps"]}, "pdf, png, svg"),
    ],
)
def test_impossible_figures_are_refused_beforehand(names, options, said, tmp_path):
    with pytest.raises(UsageError, match=said):
        write_figures(simulate_walled(), tmp_path / "new", ["positions", *names], **options)
    assert not (tmp_path / "new").exists()


def test_files_are_replaced_only_by_force(tmp_path):
    (path,) = write_figures(simulate_walled(), tmp_path, ["contact"], formats=["pdf"])
    data = path.read_bytes()
    with pytest.raises(UsageError, match="exists"):
        write_figures(simulate_walled(), tmp_path, ["contact"], formats=["svg", "pdf"])
    assert not path.with_suffix(".svg").exists()
    path.write_bytes(b"")
    write_figures(simulate_walled(), tmp_path, ["contact"], formats=["pdf"], force=True)
    assert path.read_bytes() == data
