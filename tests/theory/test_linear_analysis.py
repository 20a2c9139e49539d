"""What linear analysis says of a scenario, in Python, in words, and as facts."""

import json

import pytest

from trilat_net.errors import UsageError
from trilat_net.reporting.figures.root_map import draw_root_map
from trilat_net.reporting.linear_text import (
    describe_delay_margin,
    describe_equilibrium,
    describe_linear_verdict,
    describe_zero_roots,
    tabulate_roots,
)
from trilat_net.theory import LinearAnalysis, analyse_linear_loop
from trilat_net.theory.linear_analysis import linear_to_json

POSE = (-0.1729, 0.0874)


@pytest.fixture(scope="module")
def calm() -> LinearAnalysis:
    return analyse_linear_loop("p_d_margin", ["control.d=1.1"], pose=(0.07, 0.23))


@pytest.fixture(scope="module")
def digital() -> LinearAnalysis:
    given = ["scheme=digital", "rate_hz=100", "link.delay_ms=0"]
    return analyse_linear_loop("paper", given, pose=POSE)


def test_above_the_edge_it_is_stable_with_a_margin(calm: LinearAnalysis) -> None:
    assert calm.verdict == "stable"
    assert calm.continuous.zeros == 2  # a pose that all share, per joint
    assert calm.margin.intervals[0].high_s == pytest.approx(0.23, abs=0.01)


def test_less_damping_than_the_edge_is_unstable() -> None:
    found = analyse_linear_loop("p_d_margin", ["control.d=0.9"], pose=(0.07, 0.23))
    assert found.verdict == "unstable"
    assert describe_linear_verdict(found).startswith("unstable: the slowest motion goes as exp(0.01")


def test_the_verdict_is_that_of_the_loop_as_it_is_computed(digital: LinearAnalysis) -> None:
    assert digital.continuous.verdict == "stable"
    assert digital.verdict == "unstable"
    assert any("the tick rate decides" in note for note in digital.notes)


def test_sampled_roots_stand_beside_where_they_differ(calm: LinearAnalysis, digital: LinearAnalysis) -> None:
    assert "re as computed" not in tabulate_roots(calm).headers
    cells = tabulate_roots(digital)
    assert cells.headers[5:7] == ("re as computed", "im as computed")
    assert any(row[5] == "same" for row in cells.rows)
    assert float(cells.rows[0][5]) > 0.0 > float(cells.rows[0][0])


def test_every_word_has_its_number(calm: LinearAnalysis) -> None:
    told = linear_to_json(calm)
    assert told["verdict"] == "stable"
    first, *_ = told["continuous"]["roots"]
    assert tabulate_roots(calm).rows[0][:2] == (f"{first['re_per_s']:.4g}", f"{first['im_rad_s']:.4g}")
    assert told["margin"]["words"] in describe_delay_margin(calm)
    assert str(told["continuous"]["zeros_by_structure"]) in describe_zero_roots(calm)
    assert list(describe_equilibrium(calm))[1].strip() == "all sites at (0.0700, 0.2300) rad"
    json.dumps(told, allow_nan=False)


def test_the_map_has_every_root_and_its_conjugate(calm: LinearAnalysis) -> None:
    axes = draw_root_map(calm).axes[0]
    lines = {str(line.get_label()): line for line in axes.lines}
    both = sum(2 if root.s.imag else 1 for root in calm.continuous.roots)
    assert len(lines["continuous"].get_xdata()) == both  # type: ignore[arg-type]
    assert "zero by structure (2)" in lines


def test_several_rates_are_told() -> None:
    found = analyse_linear_loop("two_sites", ["sites.s.rate_hz=500"], pose=POSE)
    assert found.sampled is None
    assert found.verdict == found.continuous.verdict
    assert any("several rates" in note for note in found.notes)


@pytest.mark.parametrize("roots", [0, -1, 61])
def test_a_number_of_roots_that_is_none_is_refused(roots: int) -> None:
    with pytest.raises(UsageError, match="roots is a number of roots, 1 to 60"):
        analyse_linear_loop("free", roots=roots)
