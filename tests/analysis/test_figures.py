import re

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex

from trilat_net.analysis import figures, motion, poses, quantities, style, timing

from . import logs

UNIT = re.compile(r"\((s|rad|m|N m|kg m|kg m²|ms|µs|count)\)$")
SCENARIOS = ("two_sites", "paper", "four")


def outer(figure):
    """Panels in which something is drawn."""
    return [axes for axes in figure.axes if axes.axison]


def lines(axes):
    """Lines over time, without the horizontal ones that span the panel."""
    return [line for line in axes.lines if line.get_transform() == axes.transData]


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_axis_says_its_unit(name):
    log = logs.timed(logs.virtual(name))
    for title, figure in figures.all_figures(log, logs.twin(name)):
        grid = outer(figure)
        assert grid, title
        for axes in grid:
            spec = axes.get_subplotspec()
            shared_x = len(axes.get_shared_x_axes().get_siblings(axes)) > 1
            if spec.is_last_row() or not shared_x:
                assert UNIT.search(axes.get_xlabel()), (title, axes.get_xlabel())
            if spec.is_first_col():
                assert UNIT.search(axes.get_ylabel()), (title, axes.get_ylabel())


@pytest.mark.parametrize("name", SCENARIOS)
def test_figures_are_written_and_leave_matplotlib_as_it_was(name, tmp_path):
    before = dict(mpl.rcParams)
    paths = figures.write_figures(logs.timed(logs.virtual(name)), tmp_path, logs.twin(name))
    assert len(paths) == 8
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)
    assert dict(mpl.rcParams) == before


def test_a_site_has_one_colour_in_every_figure():
    log = logs.virtual("paper")
    for figure in (
        motion.tracking_errors(log),
        motion.parameter_estimates(log),
        motion.hands_moved(log, log),
    ):
        drawn = [to_hex(line.get_color()) for line in lines(figure.axes[0])]
        assert drawn[: len(log.sites)] == [style.colour(log, site) for site in log.sites]
    for site, axes in zip(log.sites, motion.positions(log).axes[::2], strict=True):
        assert to_hex(lines(axes)[0].get_color()) == style.colour(log, site)


def test_operator_torque_is_the_torque_on_the_arm():
    log = logs.virtual("four")
    (line,) = lines(motion.operator_torques(log).axes[0])
    assert line.get_ydata().max() == pytest.approx(8.0, rel=1e-3)
    assert line.get_ydata().min() == 0.0
    assert quantities.sites_with_hands(log) == ["a"]


def test_nobody_at_the_arms_is_said():
    log = logs.virtual("free")
    for figure in (motion.operator_torques(log), motion.hands_moved(log, None)):
        assert [text.get_text() for text in figure.texts] == [motion.NO_HANDS]
    (text,) = motion.hands_moved(logs.virtual("paper"), None).texts
    assert text.get_text() == motion.NO_TWIN


def test_virtual_time_is_said_instead_of_zeros():
    (text,) = timing.loop_timing(logs.virtual("paper")).texts
    assert text.get_text() == timing.NO_CLOCK


def test_histograms_count_every_tick():
    log = logs.timed(logs.virtual("four"))
    edges = timing.bin_edges(log)
    for site in log.sites:
        assert timing.histogram(log[site].late_us, edges).sum() == len(log[site])
        assert timing.histogram(log[site].busy_us, edges).sum() == len(log[site]) - 1


def test_estimates_show_the_sites_that_are_asked_for():
    log = logs.virtual("paper")
    figure = motion.parameter_estimates(log, ["m2"])
    assert [len(lines(axes)) for axes in figure.axes] == [1] * 5
    truths = [line for line in figure.axes[3].lines if line not in lines(figure.axes[3])]
    assert [line.get_ydata()[0] for line in truths] == [2.0]  # m1 lc1 + m2 l1 of the paper's arm


def test_ages_are_drawn_per_link():
    log = logs.virtual("four")
    figure = timing.sample_age(log)
    assert len(figure.axes) == 12
    assert figure.axes[0].get_title(loc="left") == "b → a"
    ages = lines(figure.axes[0])[0].get_ydata()
    assert np.isnan(ages[0])
    assert np.nanmin(ages) >= 40.0


def test_arms_stand_where_their_angles_put_them():
    arm = logs.virtual("four").scenario.sites["c"].arm
    base, elbow, tip = poses.joints_m(arm, np.array([[np.pi / 2, -np.pi / 2]]))[0]
    assert base == pytest.approx([0.0, 0.0])
    assert elbow == pytest.approx([0.0, 0.6])
    assert tip == pytest.approx([1.0, 0.6])


def test_arms_fit_into_their_panels_with_equal_axes():
    log = logs.virtual("four")
    figure = poses.arms(log, [0.0, 1.0])
    assert len(figure.axes) == 8
    for axes in figure.axes:
        assert axes.get_aspect() == 1.0
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        for line in axes.lines:
            x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
            assert left < x.min()
            assert x.max() < right
            assert bottom < y.min()
            assert y.max() < top


@pytest.mark.parametrize("name", SCENARIOS)
def test_instants_begin_at_the_beginning_and_end_at_the_end(name):
    log = logs.virtual(name)
    instants = poses.instants_s(log)
    assert instants[0] == 0.0
    assert instants[-1] == pytest.approx(2.0)
    assert (np.diff(instants) > 0.0).all()
    assert 3 <= len(instants) <= poses.INSTANTS


def test_importing_the_package_does_not_import_matplotlib():
    import subprocess
    import sys

    code = "import sys, trilat_net; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
