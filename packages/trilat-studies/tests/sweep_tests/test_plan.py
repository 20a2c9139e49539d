"""Plans: axes are texts as a person would write them; impossible plans are refused before any run."""

import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import SHORT, plan_quick_sweep
from trilat_studies.sweep.sweep_axis import SweepAxis
from trilat_studies.sweep.sweep_plan import SweepPlan, plan_sweep

from tests.laws import Adaptive
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.scenario import load_scenario


def refused(source: str, *overrides: str, **settings: object) -> str:
    with pytest.raises((ScenarioError, UsageError)) as error:
        plan_sweep(source, overrides, **settings)  # type: ignore[arg-type]
    assert error.value.exit_code == 2
    return str(error.value)


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> SweepPlan:
    """Returns a request with two laws and three axes."""
    over = ["link.delay_ms=0:40:20", "sites.s.q0_rad.0=0.1,0.2", "link.order=newest,in_order"]
    return plan_quick_sweep(
        tmp_path_factory.mktemp("cube"), over=over, laws=["p_d", "adaptive"]
    )


@given(
    places=st.tuples(st.integers(0, 1), st.integers(0, 2), st.integers(0, 1), st.integers(0, 1))
)
def test_cells_are_numbered_row_by_row(cube: SweepPlan, places: tuple[int, ...]) -> None:
    law, delay, pose, order = places
    number = ((law * 3 + delay) * 2 + pose) * 2 + order
    cell = cube.cell(number)
    assert cell.number == number
    assert cell.law == ["p_d", "adaptive"][law]
    assert cell.values == (20.0 * delay, [0.1, 0.2][pose], ["newest", "in_order"][order])


VALUES = st.lists(st.floats(0.0, 1e3), min_size=1, max_size=4, unique=True)


@given(
    delays=VALUES,
    counts=st.lists(st.integers(0, 50), min_size=1, unique=True),
    as_array=st.booleans(),
)
def test_values_by_key_equal_axes_as_texts(
    delays: list[float], counts: list[int], as_array: bool
) -> None:
    over = {
        "link.delay_ms": np.array(delays) if as_array else delays,
        "control.d": np.array(counts) if as_array else counts,
        "link.order": ["newest", "in_order"],
    }
    first, second, third = map(SweepAxis.parse, SweepAxis.list_descriptions(over))
    assert [first.value(n) for n in range(len(delays))] == delays
    assert [second.value(n) for n in range(len(counts))] == counts
    assert third == SweepAxis.parse("link.order=newest,in_order")
    assert SweepAxis.list_descriptions("link.delay_ms=0:400:50") == SweepAxis.list_descriptions(
        {"link.delay_ms": "0:400:50"}
    )


def test_laws_may_be_classes_and_vectors_single_values() -> None:
    laws, poses = SweepAxis.list_descriptions(
        {"control.law": [Adaptive, "p_d"], "sites.s.q0_rad": np.eye(2)}
    )
    assert laws == 'control.law="tests.laws:Adaptive",p_d'
    assert len(SweepAxis.parse(laws).texts) == len(SweepAxis.parse(poses).texts) == 2
    with pytest.raises(ScenarioError, match="cannot be a value in a scenario"):
        SweepAxis.list_descriptions({"control.d": [None]})


@given(number=st.integers(0, 23), seed=st.integers(1, 3))
def test_a_cell_is_its_scenario_with_overrides(cube: SweepPlan, number: int, seed: int) -> None:
    scenario = cube.scenario(*cube.cell(number).overrides, f"seed={seed}")
    delay_ms, pose, order = cube.cell(number).values
    assert {link.delay_ms for link in scenario.links.values()} == {delay_ms}
    assert {link.order for link in scenario.links.values()} == {order}
    assert (scenario.sites["s"].q0_rad, scenario.seed) == ((pose, 0.1), seed)
    assert {spec.control.__struct_config__.tag for spec in scenario.sites.values()} == {
        cube.cell(number).law
    }


def test_there_is_no_cell_beyond_the_last(cube: SweepPlan) -> None:
    assert cube.shape == (2, 3, 2, 2)
    assert cube.cells == 24
    for number in (-1, 24):
        with pytest.raises(UsageError, match="numbered from 0 to 23"):
            cube.cell(number)


def test_facts_restore_the_plan(cube: SweepPlan) -> None:
    again = SweepPlan.from_facts(json.loads(json.dumps(cube.facts())))
    assert again.facts() == cube.facts()
    assert again.base == cube.base
    assert [again.cell(n) for n in range(24)] == [cube.cell(n) for n in range(24)]
    assert (again.seeds, again.longest_s) == (cube.seeds, cube.longest_s)


def test_a_law_of_all_sites_keeps_its_gains() -> None:
    plan = plan_sweep("p_d_margin", ["control.K=7"], laws=["p_d", "pd_d"])
    stays, other = (plan.scenario(*plan.cell(n).overrides).sites["s"].control for n in (0, 1))
    assert (stays.K, stays.d) == ((7.0, 7.0), (1.1, 1.1))
    assert (other.K, other.Kd, other.d) == ((7.0, 7.0), (3.0, 3.0), (5.0, 5.0))


def test_another_law_replaces_every_sites_law_and_gains() -> None:
    plan = plan_sweep("contact", laws=["p_f", "p_d"])
    assert plan.cell(0).overrides == ()
    of_all = plan.scenario(*plan.cell(1).overrides)
    assert {spec.control for spec in of_all.sites.values()} == {
        load_scenario("paper", ["control.law=p_d"]).sites["s"].control
    }


def test_seeds_count_from_the_scenarios_or_are_named(tmp_path: Path) -> None:
    assert plan_quick_sweep(tmp_path).seeds == (1,)
    assert plan_quick_sweep(tmp_path, "seed=5", seeds=3).seeds == (5, 6, 7)
    assert plan_quick_sweep(tmp_path, seeds=[4, 2, 4]).seeds == (4, 2)
    assert "1 to 100000" in refused("paper", seeds=0)
    assert "1 to 100000" in refused("paper", seeds=100_001)
    assert "from 0 to 2^63 - 1, not -1" in refused("paper", seeds=[-1])


def test_undecided_cells_may_run_eight_times_as_long(tmp_path: Path) -> None:
    assert plan_quick_sweep(tmp_path).longest_s == 4.0
    assert plan_quick_sweep(tmp_path, longest_s=0.5).longest_s == 0.5
    assert plan_sweep("paper", ["duration_s=80000"]).longest_s == 86_400.0
    for longest_s in (0.4, 1e6, float("nan")):
        assert "from 0.5 s to 86400 s" in refused(
            str(tmp_path / "trio.toml"), longest_s=longest_s
        )


def test_a_single_invalid_corner_is_allowed(tmp_path: Path) -> None:
    """Bursts of 1.5 samples are too short for a loss of 0.7, which is valid with longer ones."""
    plan = plan_quick_sweep(tmp_path, over=["link.loss=0.1,0.7", "link.loss_burst=5,1.5"])
    with pytest.raises(ScenarioError, match="too short"):
        plan.scenario(*plan.cell(3).overrides)
    swapped = plan_quick_sweep(tmp_path, over=["link.loss=0.7,0.1", "link.loss_burst=1.5,5"])
    assert swapped.cells == 4


def test_a_key_without_effect_is_refused(tmp_path: Path) -> None:
    text = SHORT + "".join(f"[sites.{name}.control]\nKd = 2.0\n" for name in ("m1", "m2", "s"))
    (tmp_path / "own.toml").write_text(text)
    problem = refused(str(tmp_path / "own.toml"), over=["control.Kd=1:3:1"])
    assert "control.Kd: 1 and 2 give the same experiment" in problem
    assert "sites.NAME.control" in problem


decimals = st.decimals(-1000, 1000, places=4)
steps = st.decimals(Decimal("0.0001"), 50, places=4)


@given(
    first=decimals,
    step=steps,
    count=st.integers(1, 300),
    beyond=st.decimals(0, Decimal("0.9"), places=2),
)
def test_a_range_is_whole_steps_from_its_start(
    first: Decimal, step: Decimal, count: int, beyond: Decimal
) -> None:
    last = first + (count - 1 + beyond) * step
    axis = SweepAxis.parse(f"control.d={first}:{last}:{step}")
    assert len(axis.texts) == count
    assert axis.numeric
    values = [Decimal(text) for text in axis.texts]
    assert values == [first + n * step for n in range(count)]
    assert [axis.value(n) for n in range(count)] == [float(value) for value in values]
    downwards = SweepAxis.parse(f"control.d={values[-1]}:{first}:{-step}")
    assert [Decimal(text) for text in downwards.texts] == values[::-1]


def test_an_end_on_the_grid_is_included() -> None:
    assert list(SweepAxis.parse("a=0:1:0.3333333333").texts)[-1] == "0.9999999999"
    assert list(SweepAxis.parse("a=0:0.9999999999:0.25").texts)[-1] == "1.00"


def test_written_exponents_keep_whole_numbers_whole() -> None:
    assert list(SweepAxis.parse("rate_hz=1e2:3e2:1e2").texts) == ["100", "200", "300"]
    assert list(SweepAxis.parse("a=1e-7:2e-7:1e-7").texts) == ["0.0000001", "0.0000002"]


def test_a_list_may_hold_words_numbers_and_tables() -> None:
    axis = SweepAxis.parse(" link.order = newest, in_order ")
    assert (axis.description, axis.key, axis.texts) == (
        "link.order=newest, in_order",
        "link.order",
        ("newest", "in_order"),
    )
    assert (axis.numeric, axis.value(1)) == (False, "in_order")
    assert SweepAxis.parse("a=1,2.5,1e3").numeric
    assert SweepAxis.parse("a=true,false").value(0) == "true"
    assert SweepAxis.parse("q0_rad=[0.1,0.2],[0.3,0.4]").texts == ("[0.1,0.2]", "[0.3,0.4]")
    assert SweepAxis.parse('a="x:y,z",{b="]:,"}').texts == ('"x:y,z"', '{b="]:,"}')


def test_huge_ranges_take_no_memory() -> None:
    axis = SweepAxis.parse("a=0:1e8:0.001")
    assert len(axis.texts) == 10**11 + 1
    assert axis.texts[10**11] == "100000000.000"


@pytest.mark.parametrize(
    ("overrides", "laws"),
    [
        (["link.model=uniform"], []),
        (["link.model=uniform", "link.half_width_ms=10"], []),
        (["link.model=gamma", "link.deviation_ms=4"], []),
        (["link.model=sine", "link.amplitude_ms=5", "link.period_s=1"], []),
        (["link.preset=rtt68-loss10"], []),
        (["control.d=2"], ["p_d"]),
        (["link.model=uniform", "control.d=2"], ["p_d", "pd_d"]),
    ],
)
def test_overrides_may_need_swept_values(overrides: list[str], laws: list[str]) -> None:
    plan = plan_sweep("free", overrides, over=["link.delay_ms=20:60:20"], laws=laws)
    again = SweepPlan.from_facts(json.loads(json.dumps(plan.facts())))
    assert again.facts() == plan.facts()
    for number in range(plan.cells):
        cell = plan.cell(number)
        scenario = plan.scenario(*cell.overrides)
        assert again.scenario(*again.cell(number).overrides).sha256 == scenario.sha256
        assert {link.delay_ms for link in scenario.links.values()} == {cell.values[0]}  # type: ignore[attr-defined]
        if laws:
            assert {spec.control.__struct_config__.tag for spec in scenario.sites.values()} == {
                cell.law
            }


def test_an_axis_of_models_needs_no_widths() -> None:
    plan = plan_sweep("free", ["link.delay_ms=40"], over=["link.model=uniform,constant"])
    assert plan.cells == 2


@pytest.mark.parametrize("text", ["name = 'x'", "no TOML", "name = 'x'\nsites = 5\n"])
def test_a_broken_scenario_is_refused_with_laws(text: str, tmp_path: Path) -> None:
    (tmp_path / "broken.toml").write_text(text)
    with pytest.raises(ScenarioError, match="broken"):
        plan_sweep(tmp_path / "broken.toml", laws=["p_d"], over=["control.d=1,2"])
