"""What linear analysis says of a scenario, in Python, in words, and as facts."""

import json
from dataclasses import FrozenInstanceError

import pytest

from trilat_net.errors import UsageError
from trilat_net.linear import Analysis, analyse
from trilat_net.linear.facts import facts
from trilat_net.linear.figure import root_map
from trilat_net.linear.words import margin_line, resting, table, verdict, zeros

POSE = (-0.1729, 0.0874)


@pytest.fixture(scope="module")
def calm() -> Analysis:
    return analyse("p_d_margin", ["control.d=1.1"], pose=(0.07, 0.23))


@pytest.fixture(scope="module")
def digital() -> Analysis:
    given = ["scheme=digital", "rate_hz=100", "link.delay_ms=0"]
    return analyse("paper", given, pose=POSE)


def test_it_is_frozen_and_has_all(calm: Analysis) -> None:
    assert calm.verdict == "stable"
    assert calm.continuous.zeros == 2  # a pose that all share, per joint
    assert calm.margin.spans[0].high_s == pytest.approx(0.23, abs=0.01)
    with pytest.raises(FrozenInstanceError):
        calm.notes = ()  # type: ignore[misc]


def test_less_damping_than_the_edge_is_unstable() -> None:
    found = analyse("p_d_margin", ["control.d=0.9"], pose=(0.07, 0.23))
    assert found.verdict == "unstable"
    assert verdict(found).startswith("unstable: the slowest motion goes as exp(0.01")


def test_the_verdict_is_that_of_the_loop_as_it_is_computed(digital: Analysis) -> None:
    assert digital.continuous.verdict == "stable"
    assert digital.verdict == "unstable"
    assert any("the tick rate decides" in note for note in digital.notes)


def test_sampled_roots_stand_beside_where_they_differ(calm: Analysis, digital: Analysis) -> None:
    assert "re as computed" not in table(calm).heads
    cells = table(digital)
    assert cells.heads[5:7] == ("re as computed", "im as computed")
    assert any(row[5] == "same" for row in cells.rows)
    assert float(cells.rows[0][5]) > 0.0 > float(cells.rows[0][0])


def test_every_word_has_its_number(calm: Analysis) -> None:
    told = facts(calm)
    assert told["verdict"] == "stable"
    first, *_ = told["continuous"]["roots"]
    assert table(calm).rows[0][:2] == (f"{first['re_per_s']:.4g}", f"{first['im_rad_s']:.4g}")
    assert told["margin"]["words"] in margin_line(calm)
    assert str(told["continuous"]["zeros_by_structure"]) in zeros(calm)
    assert list(resting(calm))[1].strip() == "all sites at (0.0700, 0.2300) rad"
    json.dumps(told, allow_nan=False)


def test_the_map_has_every_root_and_its_conjugate(calm: Analysis) -> None:
    axes = root_map(calm).axes[0]
    lines = {str(line.get_label()): line for line in axes.lines}
    both = sum(2 if root.s.imag else 1 for root in calm.continuous.roots)
    assert len(lines["continuous"].get_xdata()) == both  # type: ignore[arg-type]
    assert "zero by structure (2)" in lines


def test_several_rates_are_told() -> None:
    found = analyse("two_sites", ["sites.s.rate_hz=500"], pose=POSE)
    assert found.sampled is None
    assert found.verdict == found.continuous.verdict
    assert any("several rates" in note for note in found.notes)


@pytest.mark.parametrize("roots", [0, -1, 61])
def test_a_number_of_roots_that_is_none_is_refused(roots: int) -> None:
    with pytest.raises(UsageError, match="--roots is how many roots are shown, 1 to 60"):
        analyse("free", roots=roots)
