"""Figures of a log: their content, per figure and per marker.

Sizes and types are tested in test_registry.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_hex

import trilat_net
from tests.analysis.builders import make_busy_run, make_short_log
from tests.log.builders import add_clock_readings
from tests.presentation.figure_content import list_curves
from tests.scenario.builders import planar_task_text
from trilat_net.analysis import site_signals
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.analysis.link_summary import DelayDistribution
from trilat_net.analysis.timeline import Timeline
from trilat_net.errors import UsageError
from trilat_net.presentation import style
from trilat_net.presentation.appearance import SITE_COLOURS, list_site_colours
from trilat_net.presentation.figures import (
    age_and_lateness,
    arm_poses,
    compared_runs,
    joint_motion,
    registry,
    run_overview,
)
from trilat_net.presentation.figures.registry import FIGURES
from trilat_net.presentation.plot_signals import sample_ages_ms
from trilat_net.scenario import load_scenario, parse_scenario

BACKGROUND = 0.6
"""What marks are drawn at or below, so that lines cover them."""


def list_marks(figure):
    """Returns the marks behind the lines of all panels: shades, and lines at changes."""
    shades = [p for axes in figure.axes for p in axes.patches if p.get_zorder() < BACKGROUND]
    changes = [
        line for axes in figure.axes for line in axes.lines if line.get_zorder() == BACKGROUND
    ]
    return shades, changes


def test_a_site_has_one_colour_in_every_figure():
    log = make_short_log("paper")
    for figure in (
        FIGURES["tracking_errors"].draw(log),
        FIGURES["parameter_estimates"].draw(log),
        joint_motion.draw_operator_displacement(log, twin=log),
    ):
        drawn = [to_hex(line.get_color()) for line in list_curves(figure.axes[0])]
        assert drawn[: len(log.sites)] == [style.site_colour(log, site) for site in log.sites]
    for site, axes in zip(log.sites, FIGURES["positions"].draw(log).axes[::2], strict=True):
        assert to_hex(list_curves(axes)[0].get_color()) == style.site_colour(log, site)


def test_a_single_site_has_the_widest_line():
    log = make_short_log("paper")
    first = SimpleNamespace(sites=log.sites[:1], scenario=log.scenario)
    assert style.site_line(first, log.sites[0]) == style.site_line(log, log.sites[0])


def test_histograms_count_every_tick():
    log = add_clock_readings(make_short_log("four"))
    bins = age_and_lateness.LoopTimeBins.of_log(log)
    for site in log.sites:
        assert bins.count_times(log[site].late_us).sum() == len(log[site])
        assert bins.count_times(log[site].busy_us).sum() == len(log[site]) - 1


@pytest.mark.long
def test_a_log_without_events_has_no_markers():
    log = make_short_log("paper")
    for name in registry.list_drawable_figures(log):
        drawn = registry.figure(log, name)
        if name != "certificate":  # which marks a rise of V
            assert list_marks(drawn) == ([], []), name
        assert drawn.get_supxlabel() == ""


def test_every_panel_of_a_site_shows_its_changes(monkeypatch):
    log = make_busy_run().log
    timeline = Timeline(log)
    figure = FIGURES["positions"].draw(log)
    for site, row in zip(log.sites, np.reshape(figure.axes, (3, 2)), strict=True):
        for axes in row:
            at_s = [
                line.get_xdata()[0] for line in axes.lines if line.get_zorder() == BACKGROUND
            ]
            assert at_s == {"a": [3.0], "b": [], "c": [1.0, 4.0]}[site]
            drawn = [
                edge for p in axes.patches for edge in (p.get_x(), p.get_x() + p.get_width())
            ]
            assert drawn == pytest.approx(
                [edge for span in timeline.find_mode_intervals(site) for edge in span[1:]]
            )
    shades, changes = list_marks(FIGURES["tracking_errors"].draw(log))
    assert len(changes) == 3 * 3
    assert len(shades) == 3 * sum(len(timeline.find_mode_intervals(site)) for site in log.sites)
    assert "1: a → c 90 ms, loss 10 %" in figure.get_supxlabel()
    assert "holds" in figure.get_supxlabel()
    monkeypatch.setattr(style, "MOST_EXPLAINED_CHANGES", 1)
    assert "and 2 more" in FIGURES["operation"].draw(log).get_supxlabel()


def test_the_stated_mean_is_drawn_while_valid():
    log = make_busy_run().log
    figure = FIGURES["sample_age"].draw(log)
    panel = next(axes for axes in figure.axes if axes.get_title(loc="left") == "a → c")
    t_s, mean_ms = list_curves(panel)[-1].get_data()
    assert list(t_s) == pytest.approx([0.0, 1.0, 1.0, 1.0, 6.0, 6.0])
    assert mean_ms == pytest.approx([50.0, 50.0, np.nan, 90.0, 90.0, np.nan], nan_ok=True)
    measured = trilat_net.simulate(
        "two_sites", {"duration_s": 0.5, "rate_hz": 200, "link.model": "measured"}
    )
    figure = FIGURES["sample_age"].draw(measured)
    assert all(np.isnan(list_curves(axes)[-1].get_ydata()).all() for axes in figure.axes)
    assert "mean delay as stated" not in [
        text.get_text() for text in figure.legends[0].get_texts()
    ]


def test_each_site_has_estimates_beside_the_truth():
    figure = FIGURES["parameter_estimates"].draw(make_short_log("paper"))
    assert [len(list_curves(axes)) for axes in figure.axes] == [3] * 5
    truths = [line for line in figure.axes[3].lines if line not in list_curves(figure.axes[3])]
    # m1 lc1 + m2 l1 of the paper's arm
    assert [line.get_ydata()[0] for line in truths] == [2.0]


def test_distributions_show_rare_long_ages():
    for few, even in ((20.0, True), (1.0, False)):
        ages_ms = np.where(np.arange(1000) < 10.0 * few, 3200.0, 200.0)
        axis = age_and_lateness.DelayAxis.of_links(
            [DelayDistribution("a", "b", np.full(9, 200.0), ages_ms)]
        )
        assert axis.x_ms[-1] >= 3200.0
        assert (axis.x_ms[0] == 0.0) == even
        assert axis.is_logarithmic != even


def test_ages_that_alternate_are_a_band():
    link = {"links.m->s.model": "uniform", "links.m->s.delay_ms": 50.0}
    log = trilat_net.simulate("two_sites", {"duration_s": 2.0, **link})
    swinging, steady = FIGURES["sample_age"].draw(log).axes[::-1]
    assert not steady.collections
    (band,) = swinging.collections
    ages_ms = sample_ages_ms(log, "s")
    extremes_ms = [np.nanmin(ages_ms), np.nanmax(ages_ms)]
    assert band.get_datalim(swinging.transData).intervaly.tolist() == extremes_ms
    median = list_curves(swinging)[0].get_ydata()
    known = median[np.isfinite(median)]
    assert ((known > extremes_ms[0]) & (known < extremes_ms[1])).all()
    assert len(known) > 100


def test_slave_colours_are_independent_of_masters():
    for name, slaves in (("two_sites", 1), ("paper", 2), ("training", 2)):
        colours = list_site_colours(load_scenario(name))
        assert len(set(colours)) == len(SITE_COLOURS)
        assert colours[slaves] == SITE_COLOURS[2]


def test_ages_after_an_outage_are_logarithmic():
    for outage_ms in (0.0, 5000.0):
        values = np.append(np.full(1000, 200.0), 200.0 + outage_ms)
        assert age_and_lateness.needs_log_axis(values) == (outage_ms > 0.0)
    assert not age_and_lateness.needs_log_axis(np.full(3, np.nan))


def test_shares_are_fractions_of_the_total():
    axis = age_and_lateness.DelayAxis(np.array([0.0, 2.0, 9.0]))
    percent = axis.compute_percent(np.array([1.0, 2.0, 2.0, 4.0]))
    assert percent.tolist() == [0, 75, 100]
    assert np.isnan(axis.compute_percent(np.zeros(0))).all()


def test_arms_stand_in_panels_with_equal_axes():
    log = make_short_log("four")
    arm = build_arm_rows(log.scenario, "c")
    base, elbow, end_effector = arm.joint_positions_m(np.array([[np.pi / 2, -np.pi / 2]]))[0]
    assert [*base, *elbow, *end_effector] == pytest.approx([0.0, 0.0, 0.0, 0.6, 1.0, 0.6])
    figure = FIGURES["arms"].draw(log)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    instants = [float(title.removeprefix("t = ").removesuffix(" s")) for title in titles]
    assert len(figure.axes) == 4 * len(instants)
    for axes in figure.axes:
        assert axes.get_aspect() == 1.0
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        points = np.concatenate([np.transpose(line.get_data()) for line in axes.lines])
        assert (points > (left, bottom)).all()
        assert (points < (right, top)).all()
    assert (instants[0], instants[-1]) == (0.0, pytest.approx(2.0))
    assert (np.diff(instants) > 0.0).all()
    assert 3 <= len(instants) <= arm_poses.INSTANTS


def test_long_paths_are_thinned_between_ends():
    turns = np.linspace(0.0, 6.0, 20_001) ** 3  # ever faster
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    kept = joint_motion.thin_path(circle)
    assert len(kept) < 0.6 * len(circle)
    assert kept[0].tolist() == circle[0].tolist()
    assert kept[-1].tolist() == circle[-1].tolist()
    assert np.unique(joint_motion.thin_path(np.ones((5, 2))), axis=0).tolist() == [[1.0, 1.0]]
    gaps = np.hypot(*np.diff(kept, axis=0).T)
    assert gaps.max() < 2 * 0.01 * 2 + np.hypot(*np.diff(circle, axis=0).T).max()


def test_a_triangle_stands_where_a_site_settles():
    log = make_short_log("two_sites")
    (axes,) = FIGURES["settling"].draw(log).axes
    marks = [line.get_data() for line in axes.lines if line.get_marker() == "v"]
    settled = [site_signals.settling_time_s(log[site]) for site in log.sites]
    assert [float(t) for (t,), _ in marks] == pytest.approx(
        [t for t in settled if t is not None]
    )
    assert all(float(y) == site_signals.SETTLED_ERROR_RAD for _, (y,) in marks)


def test_phase_portraits_show_e_and_its_rate():
    log = make_short_log("paper")
    line = FIGURES["phase"].draw(log).axes[1].lines[0]
    part = log["m1"]
    both = np.stack([part.e[:, 1], (part.qd - part.qd_des)[:, 1]], axis=1)
    assert {tuple(row) for row in np.transpose(line.get_data()).tolist()} <= {
        tuple(r) for r in both.tolist()
    }


def test_torque_limits_are_drawn_where_reached():
    free = FIGURES["control_torques"].draw(make_short_log("paper"))
    assert [text.get_text() for text in free.legends[0].get_texts()][-1] != "limit"
    log = trilat_net.simulate(
        "paper", {"duration_s": 1, "rate_hz": 200, "limits.tau_limit_nm": 20}
    )
    figure = FIGURES["control_torques"].draw(log)
    assert [text.get_text() for text in figure.legends[0].get_texts()][-1] == "limit"
    axes = figure.axes[0]
    assert {line.get_ydata()[0] for line in axes.lines if line not in list_curves(axes)} == {
        20.0,
        -20.0,
    }


RAMPS = [
    {"at_s": 0.5, "dominance": "s", "to": {"m1": 1.0, "m2": 0.0}, "ramp_s": 1.0},
    {"at_s": 1.0, "dominance": "s", "to": {"m1": 0.0, "m2": 1.0}, "ramp_s": 0.5},
]
"""The second ramp starts half-way through the first one, at 0.75."""


def test_shares_are_drawn_as_they_change():
    log = trilat_net.simulate("paper", {"duration_s": 2.0, "rate_hz": 100, "timeline": RAMPS})
    figure = FIGURES["authority"].draw(log)
    assert len(figure.axes) == 3
    m1, m2 = (line.get_data() for line in list_curves(figure.axes[0])[:2])
    assert np.interp([0.4, 0.75, 1.0, 1.25, 1.6], *m1) == pytest.approx(
        [0.5, 0.625, 0.75, 0.375, 0.0]
    )
    assert m1[1] + m2[1] == pytest.approx(np.ones(len(m1[0])))
    assert "authority" not in registry.list_drawable_figures(make_short_log("paper"))


def test_overview_has_all_extremes_and_the_verdict():
    log = make_short_log("paper")
    overview = run_overview.draw_overview(log)
    errors, _, torques, _ = overview.axes
    for site, error, torque in zip(
        log.sites, list_curves(errors), list_curves(torques), strict=False
    ):
        assert np.nanmax(error.get_ydata()) == np.abs(log[site].e).max()
        assert np.nanmax(torque.get_ydata()) == np.abs(log[site].tau).max()
    assert str(trilat_net.certify(log).stability) in overview.legends[0].get_title().get_text()


def test_overlaid_runs_share_sites_and_kind():
    paper = make_short_log("paper")
    task = trilat_net.simulate(parse_scenario(planar_task_text(0.02)))
    overlay = run_overview.draw_overlay({"one": paper, "two": make_short_log("four")})
    curve, _ = list_curves(overlay.axes[2])
    assert np.nanmax(curve.get_ydata()) == max(
        np.abs(paper[site].tau).max() for site in paper.sites
    )
    texts = [text.get_text() for text in overlay.legends[0].get_texts()]
    assert [text.partition(":")[0] for text in texts] == ["one", "two"]
    with pytest.raises(UsageError, match="in the same unit"):
        run_overview.draw_overlay({"a": paper, "b": task})


@pytest.mark.parametrize(
    ("name", "field"),
    [("positions", "q"), ("tracking_errors", "e"), ("control_torques", "tau")],
)
def test_compared_runs_have_a_line_per_run(name: str, field: str) -> None:
    """In each panel of a site and joint, every run has its own dashes and the site's colour."""
    runs = {
        "soft": trilat_net.simulate("paper", {"duration_s": 1.0, "rate_hz": 100}),
        "stiff": trilat_net.simulate(
            "paper", {"duration_s": 1.5, "rate_hz": 100, "control.Kd": 9, "link.delay_ms": 80}
        ),
    }
    figure = compared_runs.draw_compared_runs(runs, name)
    sites = runs["soft"].sites
    assert len(figure.axes) == 2 * len(sites)
    for panel, axes in enumerate(figure.axes):
        site = sites[panel // 2]
        joint = panel % 2
        assert len({line.get_linestyle() for line in axes.lines}) == len(runs)
        assert {line.get_color() for line in axes.lines} == {
            style.site_colour(runs["soft"], site)
        }
        for line, log in zip(axes.lines, runs.values(), strict=True):
            values = getattr(log[site], field)[:, joint]
            assert np.nanmax(line.get_ydata()) == values.max()
            assert np.nanmin(line.get_ydata()) == values.min()
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[len(sites) :] == [
        "soft: duration_s = 1, control.Kd = 3, every link 200 ms",
        "stiff: duration_s = 1.5, control.Kd = 9, every link 80 ms",
    ]


def test_compared_runs_share_their_sites() -> None:
    """Sites that one run lacks have no panels, and no common site or five runs are refused."""
    two = trilat_net.simulate("two_sites", {"duration_s": 0.2, "rate_hz": 100})
    paper = trilat_net.simulate("paper", {"duration_s": 0.2, "rate_hz": 100})
    runs = {"paper": paper, "two": two}
    assert compared_runs.list_common_sites(runs) == ["s"]
    assert len(compared_runs.draw_compared_runs(runs, "positions").axes) == 2
    with pytest.raises(UsageError, match="at most 4 runs"):
        compared_runs.draw_compared_runs({str(n): two for n in range(5)}, "positions")


def test_figures_show_themselves_in_a_notebook() -> None:
    log = trilat_net.simulate("two_sites", duration_s=0.1)
    drawn = trilat_net.figure(log)
    assert drawn._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    assert drawn._repr_png_() == trilat_net.figure(log, "positions")._repr_png_()  # type: ignore[attr-defined]
    assert 'src="data:image/png;base64,' in drawn._repr_html_()  # type: ignore[attr-defined]


@pytest.mark.parametrize("scenario", ["two_sites", "six_joints", "wall_in_space"])
def test_sites_show_themselves_in_a_notebook(scenario: str) -> None:
    log = trilat_net.simulate(scenario, duration_s=0.1)
    for site in log.values():
        html = site._repr_html_()
        for field in ("q", "qd", "tau"):
            for joint in range(site.q.shape[1]):
                assert f">{field}[{joint}]</td>" in html
        assert f"{len(site)} records of" in html
        assert html.count("<tr>") == html.count("</tr>")
