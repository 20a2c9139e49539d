"""The plane of a map: every run in just one place, labels, and edges between decided places that differ."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import (
    DAMPINGS,
    DELAYS_MS,
    MAP_KEYS,
    P_D,
    judge_by_condition,
    make_map_plane,
    make_map_rows,
)
from trilat_studies.sweep.map_plane import CELL_CLASSES, MapPlane, PlaneAxis, StabilityEdge
from trilat_studies.sweep.sweep_axis import label_axis, label_setting
from trilat_studies.sweep.sweep_cell import CellClass

from trilat_net.errors import UsageError
from trilat_net.scenario import load_scenario
from trilat_net.scenario.scenario_reader import list_shipped


@given(st.permutations(range(50)), st.integers(0, 2**16))
def test_runs_in_any_order_are_counted_once(order: list[int], chance: int) -> None:
    """A cell of the map counts the verdicts of its own runs, in any order of the rows."""
    random = np.random.default_rng(chance)
    shuffled_rows = list(
        make_map_rows(lambda *_, **__: CELL_CLASSES[random.integers(4)], seeds=2)
    )
    plane = MapPlane.arrange_rows([shuffled_rows[n] for n in order], MAP_KEYS, P_D)
    (panel,) = plane.panels
    assert panel.counts.sum() == 50
    for i, damping in enumerate(DAMPINGS):
        for j, delay_ms in enumerate(DELAYS_MS):
            verdicts = [
                row["verdict"]
                for row in shuffled_rows
                if (row[MAP_KEYS[0]], row[MAP_KEYS[1]]) == (delay_ms, damping)
            ]
            expected = [verdicts.count(verdict.value) for verdict in CELL_CLASSES]
            assert panel.counts[i, j].tolist() == expected


def test_the_share_is_of_decided_runs() -> None:
    verdicts = (
        CellClass.CONVERGED,
        CellClass.BOUNDED,
        CellClass.UNDECIDED,
        CellClass.CONVERGED,
    )
    plane = make_map_plane(lambda *place: verdicts[place[-1] - 1], seeds=4)
    assert np.allclose(plane.panels[0].share, 2.0 / 3.0)
    assert plane.seeds == 4


def test_undecided_places_have_no_share() -> None:
    assert np.isnan(make_map_plane(lambda *_, **__: CellClass.UNDECIDED).panels[0].share).all()


def test_words_and_further_axes_make_panels() -> None:
    plane = make_map_plane(link__order=("newest", "in_order"), link__playout_ms=(0.0, 400.0))
    assert [panel.title for panel in plane.panels] == [
        "newest, playout 0 ms",
        "newest, playout 400 ms",
        "in order, playout 0 ms",
        "in order, playout 400 ms",
    ]
    assert plane.panels[1].settings == (("link.order", "newest"), ("link.playout_ms", 400.0))
    assert {int(panel.counts.sum()) for panel in plane.panels} == {
        len(DELAYS_MS) * len(DAMPINGS)
    }


def test_an_axis_of_words_is_never_drawn() -> None:
    ordered_rows = list(make_map_rows(link__order=("newest", "in_order")))
    plane = MapPlane.arrange_rows(ordered_rows, ["link.order", *MAP_KEYS], P_D)
    assert (plane.x.key, plane.y.key) == MAP_KEYS
    assert len(plane.panels) == 2


def test_a_single_axis_is_a_strip() -> None:
    plane = MapPlane.arrange_rows(
        [row for row in make_map_rows() if row["control.d"] == 0.7], ["link.delay_ms"], P_D
    )
    assert (plane.y.key, plane.y.values) == ("", (0.0,))
    assert plane.panels[0].counts.shape == (1, 5, 4)


def test_whole_numbers_stay_whole() -> None:
    assert all(isinstance(value, int) for value in make_map_plane().x.values)


@pytest.mark.parametrize(
    ("values", "even"), [((1.0, 2.0, 3.0), True), ((1.0, 2.0, 4.0), False), ((7.0,), True)]
)
def test_uneven_values_are_drawn_one_apart(values: tuple[float, ...], even: bool) -> None:
    side = PlaneAxis("k", values, "k")
    assert side.is_evenly_spaced is even
    assert side.positions.tolist() == list(values if even else range(len(values)))


def test_no_runs_numbers_or_panels_are_refused() -> None:
    with pytest.raises(UsageError, match="no cell has run"):
        MapPlane.arrange_rows([], MAP_KEYS, P_D)
    with pytest.raises(UsageError, match=r"needs a numeric axis, .* not numbers: link\.order"):
        MapPlane.arrange_rows(
            list(make_map_rows(link__order=("newest", "in_order"))), ["link.order"], P_D
        )
    with pytest.raises(UsageError, match=r"at most 12 panels, but rate_hz would give 13"):
        make_map_plane(rate_hz=tuple(range(13)))


YES, NO, UNKNOWN = CellClass.CONVERGED, CellClass.DIVERGED, CellClass.UNDECIDED


def list_column_edges(column: tuple[CellClass, ...]) -> list[StabilityEdge]:
    """Returns the edges of the first column of a map whose columns are alike."""
    plane = make_map_plane(lambda _, d, *__: column[DAMPINGS.index(d)])
    return [edge for x, edge in plane.find_edges(plane.panels[0]) if x == DELAYS_MS[0]]


def test_the_condition_lies_in_its_own_edges() -> None:
    plane = make_map_plane()
    measured = plane.find_edges(plane.panels[0])
    assert [x for x, _ in measured] == [100, 200, 300, 400]
    for x, edge in measured:
        assert edge.low <= 5e-3 * x <= edge.high
        assert not edge.stable_below


@pytest.mark.parametrize("column", list(itertools.product((YES, NO, UNKNOWN), repeat=5))[::7])
def test_edges_separate_all_decided_places(column: tuple[CellClass, ...]) -> None:
    """From below, the side changes at every edge and nowhere else."""
    edges = list_column_edges(column)
    stable_at = {d: verdict.stable for d, verdict in zip(DAMPINGS, column, strict=True)}
    decided = [d for d, is_stable in stable_at.items() if is_stable is not None]
    changes = [
        (lower, upper)
        for lower, upper in itertools.pairwise(decided)
        if stable_at[lower] is not stable_at[upper]
    ]
    assert [(edge.low, edge.high) for edge in edges] == changes
    for edge in edges:
        assert edge.stable_below is stable_at[edge.low]


def test_undecided_places_widen_an_edge() -> None:
    (edge,) = list_column_edges((NO, UNKNOWN, UNKNOWN, YES, YES))
    assert (edge.low, edge.high, edge.middle) == (0.2, 1.7, pytest.approx(0.95))


def test_majorities_of_runs_decide_and_draws_do_not() -> None:
    """Per place seeds 1 and 2 follow the line, and seed 3 contradicts: a majority of two of three."""
    three = make_map_plane(
        lambda x, y, seed: judge_by_condition(x, y) if seed < 3 else YES, seeds=3
    )
    assert three.find_edges(three.panels[0]) == make_map_plane().find_edges(
        make_map_plane().panels[0]
    )
    draw = make_map_plane(
        lambda x, y, seed: judge_by_condition(x, y) if seed < 2 or y > 1.0 else YES, seeds=2
    )
    assert all(edge.low > 1.0 or edge.high > 1.0 for _, edge in draw.find_edges(draw.panels[0]))


@pytest.mark.parametrize("half_width_ms", [0.0, 50.0])
def test_labels_call_drawn_delays_stated(half_width_ms: float) -> None:
    """The newest sample counts, so that the age in use is smaller than a drawn delay."""
    scenario = load_scenario("free")
    link = {"model": "uniform", "delay_ms": 200.0, "half_width_ms": half_width_ms}
    if half_width_ms:
        scenario = load_scenario("free", {"links.m1->s": link})
    prefix = "stated " if half_width_ms else ""
    assert label_axis("link.delay_ms", scenario) == f"{prefix}delay (ms)"
    assert label_axis("links.m1->s.delay_ms", scenario) == f"{prefix}delay m1->s (ms)"
    assert label_axis("links.s->m1.delay_ms", scenario) == "delay s->m1 (ms)"
    assert label_axis("control.Kd", scenario) == label_axis("control.Kd")


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("link.delay_ms", "delay (ms)"),
        ("link.half_width_ms", "half width (ms)"),
        ("link.loss", "loss"),
        ("rate_hz", "rate (Hz)"),
        ("control.K", "K (N m/rad)"),
        ("control.d", "d (N m s/rad)"),
        ("control.Gamma", "Gamma"),
        ("arm.I1_kg_m2", "I1 (kg m²)"),
        ("limits.qd_limit_rad_s", "qd limit (rad/s)"),
        ("sites.m.control.k_f", "k_f of m"),
        ("links.m1->s.delay_ms", "delay m1->s (ms)"),
        ("dominance.s.m1", "m1's share in s"),
        ("sites.s.q0_rad.1", "q0[1] of s (rad)"),
    ],
)
def test_keys_are_shown_in_words_with_units(key: str, text: str) -> None:
    assert label_axis(key) == text


def test_the_scenario_gives_a_numbers_meaning() -> None:
    key = "sites.s.environment.0.stiffness_n_m"
    assert label_axis(key, load_scenario("contact")) == "stiffness, wall of s (N/m)"
    assert (
        label_axis("sites.m.hands.0.damping_nm_s_rad", load_scenario("contact"))
        == "damping, spring of m (N m s/rad)"
    )


def test_suffixes_of_shipped_arms_and_limits_are_units() -> None:
    """No label shows a piece of a unit as if it were a word."""
    spec = next(iter(load_scenario(list_shipped()[0]).sites.values()))
    for table in (spec.arm, spec.limits):
        for field in table.__struct_fields__:
            unit = field.endswith(("_m", "_kg", "_m2", "_s2", "_nm", "_s", "_rad"))
            if unit:
                assert label_axis(f"arm.{field}").endswith(")"), field


def test_a_place_is_shown_in_its_unit() -> None:
    assert label_setting("link.playout_ms", 400.0) == "playout 400 ms"
    assert label_setting("link.loss", 0.25) == "loss 0.25"
    assert label_setting("link.order", "in_order") == "order in order"
