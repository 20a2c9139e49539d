"""The plane of a map: every run is in just one place of one panel."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.errors import UsageError
from trilat_net.studies.sweep.cell_result import CellClass
from trilat_net.studies.sweep.map_plane import CELL_CLASSES, PlaneAxis, build_plane

from .maps import DAMPINGS, DELAYS_MS, KEYS, P_D, drawn, rows


@given(st.permutations(range(50)), st.integers(0, 2**16))
def test_every_run_is_counted_once_in_whatever_order_they_come(order: list[int], chance: int) -> None:
    random = np.random.default_rng(chance)
    made = list(rows(lambda *_: CELL_CLASSES[random.integers(4)], seeds=2))
    found = build_plane([made[n] for n in order], KEYS, P_D)
    (panel,) = found.panels
    assert panel.counts.sum() == 50
    for row in made:
        i, j = DAMPINGS.index(row[KEYS[1]]), DELAYS_MS.index(row[KEYS[0]])
        same = [r for r in made if (r[KEYS[0]], r[KEYS[1]]) == (row[KEYS[0]], row[KEYS[1]])]
        for n, verdict in enumerate(CELL_CLASSES):
            assert panel.counts[i, j, n] == sum(r["verdict"] == verdict for r in same)


def test_the_share_is_of_decided_runs() -> None:
    verdicts = (CellClass.CONVERGED, CellClass.BOUNDED, CellClass.UNDECIDED, CellClass.CONVERGED)
    found = drawn(lambda *place: verdicts[place[-1] - 1], seeds=4)
    assert np.allclose(found.panels[0].share, 2.0 / 3.0)
    assert found.seeds == 4


def test_nothing_decided_has_no_share() -> None:
    assert np.isnan(drawn(lambda *_: CellClass.UNDECIDED).panels[0].share).all()


def test_words_and_further_axes_make_panels() -> None:
    found = drawn(link__order=("newest", "in_order"), link__playout_ms=(0.0, 400.0))
    assert [panel.title for panel in found.panels] == [
        "newest, playout 0 ms",
        "newest, playout 400 ms",
        "in order, playout 0 ms",
        "in order, playout 400 ms",
    ]
    assert found.panels[1].settings == (("link.order", "newest"), ("link.playout_ms", 400.0))
    assert {int(panel.counts.sum()) for panel in found.panels} == {len(DELAYS_MS) * len(DAMPINGS)}


def test_an_axis_of_words_is_never_drawn() -> None:
    made = list(rows(link__order=("newest", "in_order")))
    found = build_plane(made, ["link.order", *KEYS], P_D)
    assert (found.x.key, found.y.key) == KEYS
    assert len(found.panels) == 2


def test_a_single_axis_is_a_strip() -> None:
    found = build_plane([row for row in rows() if row["control.d"] == 0.7], ["link.delay_ms"], P_D)
    assert (found.y.key, found.y.values) == ("", (0.0,))
    assert found.panels[0].counts.shape == (1, 5, 4)


def test_whole_numbers_stay_whole() -> None:
    assert all(isinstance(value, int) for value in drawn().x.values)


@pytest.mark.parametrize(
    ("values", "even"), [((1.0, 2.0, 3.0), True), ((1.0, 2.0, 4.0), False), ((7.0,), True)]
)
def test_uneven_values_are_drawn_one_apart(values: tuple[float, ...], even: bool) -> None:
    side = PlaneAxis("k", values, "k")
    assert side.even is even
    assert np.allclose(side.placed(np.array(values)), side.places)


def test_between_uneven_values_a_line_lies_between_their_places() -> None:
    side = PlaneAxis("k", (8.0, 68.0, 1088.0), "k")
    assert np.allclose(side.placed(np.array([38.0, 578.0])), [0.5, 1.5])
    assert np.isnan(side.placed(np.array([7.0, np.nan, 2000.0]))).all()


def test_no_runs_no_numbers_and_too_many_panels_are_refused() -> None:
    with pytest.raises(UsageError, match="no cell has run"):
        build_plane([], KEYS, P_D)
    with pytest.raises(UsageError, match=r"needs an axis of numbers, and link\.order has words only"):
        build_plane(list(rows(link__order=("newest", "in_order"))), ["link.order"], P_D)
    with pytest.raises(UsageError, match=r"at most 12 panels, and rate_hz would make 13"):
        drawn(rate_hz=tuple(range(13)))
