"""The linear analysis of a scenario, in Python, in words, and as facts.

The loop at the end of a recorded run: at several rates, over recorded samples, and of laws with
waves.
"""

import json
import math

import pytest

import trilat_net as tn
from trilat_net.analysis.theory.linear_analysis import LinearAnalysis
from trilat_net.analysis.theory.loop_roots import find_log_roots
from trilat_net.errors import UsageError
from trilat_net.presentation.figures.linear_figures import draw_root_map
from trilat_net.presentation.result_text import TextTable, compose
from trilat_net.scenario import load_scenario

POSE = (-0.1729, 0.0874)


def tabulate_roots(analysis: LinearAnalysis) -> TextTable:
    (table,) = (block for block in compose(analysis) if isinstance(block, TextTable))
    return table


@pytest.fixture(scope="module")
def calm() -> LinearAnalysis:
    return LinearAnalysis.compute("p_d_margin", ["control.d=1.1"], pose=(0.07, 0.23))


@pytest.fixture(scope="module")
def digital() -> LinearAnalysis:
    settings = ["scheme=digital", "rate_hz=100", "link.delay_ms=0"]
    return LinearAnalysis.compute("paper", settings, pose=POSE)


def test_above_the_edge_a_margin_remains(calm: LinearAnalysis) -> None:
    assert calm.verdict == "stable"
    assert calm.continuous.zeros == 2  # a pose that all share, per joint
    assert calm.margin.intervals[0].high_s == pytest.approx(0.23, abs=0.01)


def test_less_damping_than_the_edge_is_unstable() -> None:
    analysis = LinearAnalysis.compute("p_d_margin", ["control.d=0.9"], pose=(0.07, 0.23))
    assert analysis.verdict == "unstable"
    assert "\nunstable: the slowest motion goes as exp(0.01" in analysis.summary()


def test_verdicts_follow_the_computed_loop(digital: LinearAnalysis) -> None:
    assert digital.continuous.verdict == "stable"
    assert digital.verdict == "unstable"
    assert any("the tick rate decides" in note for note in digital.notes)


def test_sampled_roots_stand_beside_differing_ones(
    calm: LinearAnalysis, digital: LinearAnalysis
) -> None:
    assert "re as computed" not in tabulate_roots(calm).headers
    cells = tabulate_roots(digital)
    assert tuple(cells.headers[5:7]) == ("re as computed", "im as computed")
    assert any(row[5] == "same" for row in cells.rows)
    assert float(cells.rows[0][5]) > 0.0 > float(cells.rows[0][0])


def test_every_word_has_its_number(calm: LinearAnalysis) -> None:
    facts = calm.to_dict()
    assert facts["verdict"] == "stable"
    first, *_ = facts["continuous"]["roots"]
    assert tuple(tabulate_roots(calm).rows[0][:2]) == (
        f"{first['re_per_s']:.4g}",
        f"{first['im_rad_s']:.4g}",
    )
    assert facts["margin"]["words"] in calm.summary()
    zero_count = facts["continuous"]["zeros_by_structure"]
    lines = calm.summary().splitlines()
    assert any(line.startswith(f"{zero_count} roots are zero by structure: ") for line in lines)
    assert lines[1].strip() == "all sites at (0.0700, 0.2300) rad"
    json.dumps(facts, allow_nan=False)


def test_the_map_has_every_root_and_its_conjugate(calm: LinearAnalysis) -> None:
    axes = draw_root_map(calm).axes[0]
    lines = {str(line.get_label()): line for line in axes.lines}
    both = sum(2 if root.s.imag else 1 for root in calm.continuous.roots)
    assert len(lines["continuous"].get_xdata()) == both  # type: ignore[arg-type]
    assert "zero by structure (2)" in lines


def test_several_rates_have_roots_over_periods() -> None:
    """Two sites at 40 and 30 Hz that the continuous loop, at the mean ages, calls stable."""
    settings = ["scheme=digital", "sites.m.rate_hz=40", "sites.s.rate_hz=30", "link.delay_ms=0"]
    control = {"control": {"law": "p_d", "K": 50.0, "d": 2.0}}
    pair = load_scenario(load_scenario("two_sites", control), settings)
    analysis = LinearAnalysis.compute(pair, pose=(0.0, math.pi))
    assert (analysis.continuous.verdict, analysis.verdict) == ("stable", "unstable")
    verdict = (
        "unstable: the slowest motion goes as exp(0.1802 t / s) at 9.955 rad/s, as computed over the period "
        "of 0.1 s"
    )
    assert verdict in analysis.summary().splitlines()
    assert any("ticks and delays decide" in note for note in analysis.notes)
    assert tabulate_roots(analysis).rows[0][0] == "0.1802"
    facts = analysis.to_dict()
    assert facts["as_computed"]["span_s"] == 0.1
    assert facts["as_computed"]["deviation_per_s"] is facts["continuous"]["span_s"] is None


def test_drawn_delays_state_their_roots_accuracy() -> None:
    analysis = LinearAnalysis.compute("jitter", ["rate_hz=200"], pose=(0.07, 0.23), roots=2)
    assert analysis.sampled is not None
    assert analysis.sampled.deviation_per_s is not None
    phrase = f"over 30 s of the delays in use, +- {analysis.sampled.deviation_per_s:.1g} /s"
    text = analysis.summary()
    assert any(line.endswith(phrase) for line in text.splitlines())
    assert "mean delay in use on m2->m1" in text


def test_lasting_motions_are_separated_from_decaying() -> None:
    """Over wave lines with springs, the common speed of two joints lasts; the others decay."""
    control = {"law": "wave", "b": 60.0, "K": 50.0, "B": 5.0}
    analysis = LinearAnalysis.compute(
        "two_sites", {"scheme": "digital", "control": control}, pose=POSE
    )
    assert (
        "\nat the edge: 2 motions keep their speed, and the slowest of the other motions goes as exp(-0."
        in analysis.summary()
    )


@pytest.mark.long
def test_a_line_without_losses_has_no_margin() -> None:
    """All of its roots are on the axis at any delay; a search for crossings among them would not end."""
    control = {"law": "wave", "b": 60.0, "K": 0.0}
    settings = {"scheme": "digital", "control": control}
    analysis = LinearAnalysis.compute("two_sites", settings, pose=POSE, ports=True)
    assert (analysis.verdict, analysis.margin.lossless, analysis.margin.crossings) == (
        "at the edge",
        True,
        (),
    )
    assert analysis.margin.description.startswith("none: waves run along lines without losses")
    assert analysis.ports is not None


@pytest.mark.parametrize("roots", [0, -1, 61])
def test_invalid_numbers_of_roots_are_refused(roots: int) -> None:
    with pytest.raises(UsageError, match="roots must be from 1 to 60"):
        LinearAnalysis.compute("free", roots=roots)


def test_several_rates_have_exact_scenario_roots() -> None:
    """Both sites end where they start, a millionth apart and folded."""
    pair = {
        "sites.m.rate_hz": 40,
        "sites.s.rate_hz": 30,
        "scheme": "digital",
        "control": {"law": "p_d", "K": 50.0, "d": 2.0},
        "link.delay_ms": 0.0,
        "duration_s": 4.0,
        "sites.m.q0_rad": [0.0, 3.141592],
        "sites.s.q0_rad": [0.0, 3.141593],
    }
    roots = find_log_roots(tn.simulate("two_sites", pair))
    assert (roots.verdict, roots.exact) == ("unstable", True)
    assert roots.rate_per_s == pytest.approx(0.180, abs=1e-3)
    assert roots.text.endswith("rad/s, over the period of 0.1 s")


def test_drawn_delays_use_their_actual_samples() -> None:
    """The last quarter of the run begins 15 s later than the draws of the linear analysis, so that the draws differ."""
    run = {"rate_hz": 200, "duration_s": 40.0}
    roots = find_log_roots(tn.simulate("jitter", run))
    whole = tn.linear("jitter", run, ports=False)
    assert whole.sampled is not None
    assert whole.sampled.rightmost is not None
    assert (roots.verdict, roots.exact) == ("stable", False)
    assert roots.rate_per_s == pytest.approx(whole.sampled.rightmost.s.real, abs=0.01)
    assert "over 10 s of the delays in use, +- 0.0" in roots.text


def test_waves_are_analysed_in_continuous_time() -> None:
    control = {"law": "wave", "b": 60.0, "K": 50.0, "B": 5.0}
    roots = find_log_roots(
        tn.simulate("two_sites", {"scheme": "digital", "control": control, "duration_s": 2.0})
    )
    assert roots.text.startswith(
        "this rest: at the edge, 2 of its motions keep their speed, the others -0."
    )
    assert roots.text.endswith(", in continuous time")
