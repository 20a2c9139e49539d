"""`log.plot`: the columns, sites, joints and times of a figure, and the error for a wrong name."""

import subprocess
import sys

import numpy as np
import pytest

import trilat_net as tn
from tests.analysis.builders import make_busy_run, make_short_log
from tests.presentation.figure_content import list_curves
from tests.scenario.builders import planar_task_text
from trilat_net.errors import UnknownName, UsageError
from trilat_net.presentation import style
from trilat_net.presentation.column_plot import DEFAULT_QUANTITIES


def list_titles(figure):
    return [axes.get_title() for axes in figure.axes]


def test_the_default_is_the_overview():
    log = make_short_log("four")
    assert list_titles(log.plot()) == list_titles(tn.figure(log, "overview", width_in=7.0))


def test_a_notebook_displays_the_figure():
    figure = make_short_log("four").plot("mode")
    assert figure._repr_html_().startswith("<img")
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_a_quantity_has_a_panel_per_column():
    figure = make_short_log("paper").plot("q", "tau", "theta_hat")
    assert list_titles(figure)[:2] == ["q1 (rad)", "q2 (rad)"]
    assert list_titles(figure)[2:4] == ["tau1 (N m)", "tau2 (N m)"]
    assert list_titles(figure)[4:] == [
        "theta_hat1 (kg m²)",
        "theta_hat2 (kg m²)",
        "theta_hat3 (kg m²)",
        "theta_hat4 (kg m)",
        "theta_hat5 (kg m)",
    ]


@pytest.mark.parametrize("name", ["q", "qd", "q_des", "tau", "tau_x", "e"])
def test_curves_have_the_extremes_of_the_records(name):
    log = make_short_log("paper")
    for joint, axes in enumerate(log.plot(name).axes):
        for site, curve in zip(log.sites, list_curves(axes), strict=True):
            values = getattr(log[site], name)[:, joint]
            drawn = curve.get_ydata()
            assert (np.nanmin(drawn), np.nanmax(drawn)) == (values.min(), values.max())
            assert curve.get_color() == style.site_colour(log, site)


@pytest.mark.parametrize("name", ["q2", "q2_rad"])
def test_a_single_column_has_two_names(name):
    assert list_titles(make_short_log("four").plot(name)) == ["q2 (rad)"]


def test_every_column_of_the_table_can_be_drawn():
    log = make_short_log("four")
    for column in log.table("a").columns:
        assert len(log.plot(column.name, sites="a").axes) == 1, column.name


def test_sites_joints_and_times_restrict_a_figure():
    log = make_short_log("paper")
    figure = log.plot("q", "age", sites=["s", "m1"], joints=2, from_s=1.0, until_s=1.5)
    assert list_titles(figure) == ["q2 (rad)", "age_m2 (ms)", "age_s (ms)", "age_m1 (ms)"]
    angles = figure.axes[0]
    assert [len(list_curves(axes)) for axes in figure.axes] == [2, 2, 1, 1]
    assert angles.get_xlim() == (1.0, 1.5)
    for curve in list_curves(angles):
        assert curve.get_xdata().min() >= 1.0
        assert curve.get_xdata().max() <= 1.5
    assert list_titles(log.plot(joints="q1")) == [
        f"{name}1 ({unit})"
        for name, unit in zip(DEFAULT_QUANTITIES, ("rad", "rad", "N m"), strict=True)
    ]


def test_modes_are_steps_between_words():
    log = make_busy_run().log
    [axes] = log.plot("mode").axes
    labels = [label.get_text() for label in axes.get_yticklabels()]
    recorded = {mode for site in log.sites for mode in log[site].mode}
    assert set(labels) == recorded
    assert labels[0] == "run"
    assert {line.get_drawstyle() for line in list_curves(axes)} == {"steps-post"}


def test_changes_outside_the_time_are_not_marked():
    log = make_busy_run().log
    assert "a → c" in log.plot("q").get_supxlabel()
    assert "a → c" not in log.plot("q", until_s=0.5).get_supxlabel()
    assert not [text for axes in log.plot("q", until_s=0.5).axes for text in axes.texts]


def test_sites_with_poses_have_errors_along_axes():
    log = tn.simulate(planar_task_text(), duration_s=0.05)
    assert list_titles(log.plot("e")) == ["e_x (m)", "e_y (m)", "e_z (m)"]
    assert list_titles(log.plot("q_des", "q", joints=1)) == [
        "q_des_x (m)",
        "q_des_y (m)",
        "q_des_z (m)",
        "q1 (rad)",
    ]


@pytest.mark.parametrize(
    ("names", "selection", "error", "hint"),
    [
        (["tua"], {}, UnknownName, "did you mean 'tau'?"),
        (["zzz"], {}, UnknownName, "the quantities are"),
        (["positions"], {}, UnknownName, "trilat_net.figure(log, 'positions')"),
        (["q"], {"sites": "m9"}, UnknownName, "the sites are a, b, c, d"),
        (["q"], {"sites": []}, UsageError, "the sites are a, b, c, d"),
        (["q"], {"joints": 3}, UnknownName, "the joints of a are 1 to 2, or q1, q2"),
        (["q"], {"joints": 0}, UnknownName, "1 to 2"),
        (["q1"], {"joints": 2}, UsageError, "q1 has no column of the joints 2"),
        (["q"], {"joints": []}, UsageError, "joints is empty"),
        (["q"], {"from_s": 1.0, "until_s": 1.0}, UsageError, "less than until_s"),
        (["q"], {"from_s": 30.0}, UsageError, "the log ends at 2 s"),
        (["q"], {"from_s": 30.0, "until_s": 31.0}, UsageError, "from 0 s until 2 s"),
        (["q"], {"from_s": float("nan")}, UsageError, "less than until_s"),
    ],
)
def test_wrong_names_suggest_the_right_ones(names, selection, error, hint):
    with pytest.raises(error) as refused:
        make_short_log("four").plot(*names, **selection)
    assert hint in str(refused.value)


@pytest.mark.long
def test_without_matplotlib_its_installation_is_named():
    script = """
import sys
sys.modules["matplotlib"] = None
import trilat_net as tn
from trilat_net.errors import UsageError
log = tn.simulate("two_sites", duration_s=0.05)
try:
    log.plot()
except UsageError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.strip() == (
        "plot needs matplotlib, which trilat-net-core does not include: pip install trilat-net"
    ), done.stderr
