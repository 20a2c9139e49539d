"""Runs side by side are the runs alone, bit for bit."""

import platform
import random
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from tests.execution.varying_links import LINKS
from trilat_net.core.lanes.lane_rows import LANES
from trilat_net.core.lanes.lane_run import LaneRun
from trilat_net.core.lanes.lane_structure import RunStructure
from trilat_net.core.lanes.run_groups import LEAST_RUNS, RunGroup
from trilat_net.core.step.row_fields import FIELDS
from trilat_net.errors import LawFailed
from trilat_net.execution import virtual
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import Scenario, load_scenario

ARM6 = (files("trilat_net") / "scenarios" / "arm6.urdf").read_text("utf-8")
SLIDING = ARM6.replace('name="elbow" type="revolute"', 'name="elbow" type="prismatic"')
GLIDE = {"action": "glide", "silence_ms": 100.0}
STRUCTURES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("free", {}),
    ("p_d_margin", {}),
    ("windup", {}),
    ("two_sites", {"control.law": "wave", "scheme": "digital"}),
    ("free", {"sites.s.rate_hz": 400}),
    ("free", {"rate_hz": 3000, "sites.m1.rate_hz": 50, "sites.s.rate_hz": 333}),
    ("free", {"control.law": "tdpa", "scheme": "digital", "control.B": 5.0}),
    ("two_sites", {"control.law": "four_channel", "scheme": "digital"}),
    ("free", {"scheme": "digital", "rate_hz": 333}),
    ("asymmetric", {}),
    ("contact", {}),
    ("free", {"sites.s.on_stale": {"action": "hold", "age_ms": 205.0}}),
    ("six_joints", {}),
    ("wall_in_space", {}),
    ("six_joints", {"control.law": "p_d", "limits.tau_rate_limit_nm_s": 500.0}),
    ("six_joints", {"scheme": "digital", "rate_hz": 500}),
    ("six_joints", {"urdf": {"arm6.urdf": SLIDING}, "expect": {}}),
    ("six_joints", {"control.law": "wave", "scheme": "digital"}),
    ("six_joints", {"sites.s.rate_hz": 500, "sites.m1.on_stale": GLIDE}),
    ("six_joints", {"control.law": "impedance", "scheme": "digital"}),
    ("six_joints", {"control.law": "six_channel", "scheme": "digital"}),
    ("unlike_arms", {"control": {"law": "p_d"}, "expect": {}}),
    ("unlike_arms", {}),
    ("unlike_arms", {"task.space": "pose", "sites.s.on_stale": GLIDE}),
    ("free", {f"sites.{site}.on_stale": GLIDE for site in ("m1", "m2", "s")}),
    ("play", {}),
)
"""Scenarios whose runs differ in their equations; the quick tests use the first five."""
QUICK = STRUCTURES[:5]
ADAPTIVE = (
    "free",
    "windup",
    "asymmetric",
    "six_joints",
    "wall_in_space",
    "unlike_arms",
    "play",
)
LAWS = ("tanks", "smith", "authority", "saturated_pd", "pd_d")
STRUCTURES += tuple(("two_sites", {"control.law": law, "scheme": "digital"}) for law in LAWS)
LAWS += ("impedance", "six_channel")
GAINS = {"wave": "control.b", "tdpa": "control.K", "four_channel": "control.K"}
"""A gain of each law that is not a part of the kernel."""


def draw_cells(
    draws: random.Random, structure: tuple[str, Mapping[str, Any]], count: int
) -> list[Scenario]:
    """Cells of one structure, each with gains, links and a seed of its own."""
    name, settings = structure
    base = load_scenario(name, {"duration_s": 0.6, **settings})
    gain = "control.Kd" if name in ADAPTIVE else "control.d"
    law = settings.get("control.law", settings.get("control", {}).get("law", ""))
    gain = GAINS.get(law, "control.d" if law == "p_d" else gain)
    has_gain = law not in LAWS
    factor = 10.0 if gain in GAINS.values() else 1.0
    cells = []
    for _ in range(count):
        numbers: dict[str, float] = {"seed": draws.randrange(1000)}
        if has_gain:
            numbers[gain] = factor * draws.uniform(0.5, 3.0)
        cells.append(load_scenario(base, {**draws.choice(LINKS), **numbers}))
    return cells


def read_numbers(run: FusedRun) -> dict[str, bytes]:
    """Everything that a run computes, by field, without entries of rings that are not in use."""
    memory = run.memory
    site = memory.tables.site
    # Nothing reads intermediate results of an earlier tick.
    kept = [name for name in site.dtype.names if FIELDS["site"][name].stage != "scratch"]
    numbers = {f"site.{name}": site[name] for name in kept}
    numbers |= {f"sums.{name}": memory.sums[name] for name in memory.sums.dtype.names}
    numbers |= {
        f"progress.{name}": memory.progress[name] for name in memory.progress.dtype.names
    }
    numbers |= {"peaks": memory.peaks, "records": run.records}
    if memory.laws is not None:
        numbers |= {"laws": memory.laws.rows, "sent": memory.laws.sent}
    return {name: np.ascontiguousarray(array).tobytes() for name, array in numbers.items()}


def check_equal(run: FusedRun, alone: FusedRun) -> None:
    """Checks that two runs have the same bits."""
    expected = read_numbers(alone)
    assert [name for name, bits in read_numbers(run).items() if bits != expected[name]] == []
    assert (run.ran_s, run.diverged_s, run.totals) == (
        alone.ran_s,
        alone.diverged_s,
        alone.totals,
    )


def run_alone(scenario: Scenario, *ends_s: float) -> FusedRun:
    """The run of a scenario by itself."""
    run = FusedRun(scenario)
    for end_s in ends_s or (scenario.duration_s,):
        run.advance_to(end_s)
    return run


def check_cells(cells: Sequence[Scenario]) -> None:
    """Checks cells in lanes against each cell alone."""
    runs = [FusedRun(cell) for cell in cells]
    LaneRun(runs).advance_to(cells[0].duration_s)
    for run, cell in zip(runs, cells, strict=True):
        check_equal(run, run_alone(cell))


@pytest.mark.parametrize("structure", QUICK, ids=lambda structure: structure[0])
@pytest.mark.parametrize("count", [LANES, 5])
def test_lanes_have_the_bits_of_single_runs(
    structure: tuple[str, dict[str, Any]], count: int
) -> None:
    check_cells(draw_cells(random.Random(count), structure, count))


def check_random_cells(structures: Sequence[tuple[str, dict[str, Any]]], cells: int) -> None:
    """Checks so many cells of random structures, in groups of random sizes."""
    draws = random.Random(cells)
    while cells > 0:
        count = draws.randint(1, LANES)
        check_cells(draw_cells(draws, draws.choice(structures), count))
        cells -= count


def test_400_random_cells_have_single_run_bits() -> None:
    check_random_cells(QUICK, 400)


@pytest.mark.long
def test_2000_random_cells_have_single_run_bits() -> None:
    check_random_cells(STRUCTURES, 2000)


def test_chains_have_the_bits_of_their_runs_alone() -> None:
    """The runs have friction, stops, a robust term, and limits that some of them exceed."""
    law = {"control.law": "adaptive_robust", "control.rho_nm": 0.5}
    base = load_scenario("six_joints", {"duration_s": 0.4, **law})
    draws = random.Random(11)
    cells = [
        load_scenario(
            base,
            {
                **draws.choice(LINKS),
                "control.Kd": draws.uniform(0.5, 2.0),
                "limits.qd_limit_rad_s": draws.choice([0.3, 10.0]),
            },
        )
        for _ in range(9)
    ]
    check_cells(cells)
    ends_s = [run_alone(cell).diverged_s for cell in cells]
    assert None in ends_s
    assert len(set(ends_s)) > 1


def test_lane_has_the_bits_of_site_step() -> None:
    cells = draw_cells(random.Random(3), STRUCTURES[0], 4)
    runs = [FusedRun(cell) for cell in cells]
    LaneRun(runs).advance_to(cells[0].duration_s)
    outputs = {step.site.name: step.output for step in virtual.execute_virtual(cells[2])}
    for name, record in zip(cells[2].names, runs[2].records, strict=True):
        columns = cells[2].layout(name).columns()
        for key in ("q", "qd", "q_des", "tau", "theta_hat"):
            assert record[columns[key]].tolist() == list(getattr(outputs[name], key))


def test_lanes_end_where_their_arms_leave_the_limits() -> None:
    """Each at a time of its own; the others go on."""
    limits = np.linspace(0.5, 6.0, LANES)
    cells = [
        load_scenario("free", {"duration_s": 1.5, "limits.qd_limit_rad_s": float(limit)})
        for limit in limits
    ]
    check_cells(cells)
    ends_s = [run_alone(cell).diverged_s for cell in cells]
    assert None in ends_s
    assert len(set(ends_s)) > 3


@pytest.mark.parametrize("structure", [QUICK[0], QUICK[4]], ids=["equal-rates", "rates"])
def test_runs_continue_in_lanes_or_alone(structure: tuple[str, dict[str, Any]]) -> None:
    """Some cells are extended in lanes; then one goes on alone, with its links as they would be."""
    cells = draw_cells(random.Random(7), structure, LANES)
    runs = [FusedRun(cell) for cell in cells]
    lanes = LaneRun(runs)
    # The last tick of the slow site before 0.3037 s comes with the next ticks.
    lanes.advance_to(0.3037)
    chosen = [2, 3, 9, 14]
    lanes.keep(chosen)
    lanes.advance_to(0.7)
    for index in chosen:
        check_equal(runs[index], run_alone(cells[index], 0.3037, 0.7))
    for index in (0, 9, 14):
        ends_s = (0.3037, 0.7) if index in chosen else (0.3037,)
        runs[index].advance_to(1.0)
        alone = run_alone(cells[index], *ends_s, 1.0)
        check_equal(runs[index], alone)
        links = runs[index].memory.tables.links
        expected = alone.memory.tables.links
        assert [n for n in links.dtype.names if (links[n] != expected[n]).any()] == []
        assert (runs[index].memory.next_samples == alone.memory.next_samples).all()


def test_only_the_run_whose_law_fails_ends() -> None:
    """Some laws of users fail in a tick of their own, if the numbers of their run say so."""
    line = {"law": "tests.plugged_laws:CompiledLine"}
    base = load_scenario("asymmetric", {"link.delay_ms": 5.0, "duration_s": 0.2})
    cells = [
        load_scenario(base, {"sites.m2.control": {**line, "K": 15.0 + n, "fail_at": fail_at}})
        for n, fail_at in enumerate([-1, -1, 150, -1, 42])
    ]
    runs = [FusedRun(cell) for cell in cells]
    (group,) = RunGroup.divide(runs)
    group.advance_to(0.03)
    for run, cell in zip(runs, cells, strict=True):
        check_equal(run, run_alone(cell, 0.03))
    with pytest.raises(LawFailed, match="m2 failed at tick 149: ZeroDivisionError"):
        group.advance_to(0.2)
    for run, cell in zip(runs[:2], cells[:2], strict=True):
        check_equal(run, run_alone(cell, 0.03, 0.2))


@pytest.mark.parametrize(
    ("name", "settings", "obstacle"),
    [
        ("unlike_arms", {}, ""),
        ("play", {}, ""),
        ("free", {"sites.m1.control": {"law": "tests.plugged_laws:Line"}}, "plain Python"),
    ],
)
def test_obstacles_are_named(name: str, settings: dict[str, Any], obstacle: str) -> None:
    run = FusedRun(load_scenario(name, {"duration_s": 0.1, **settings}))
    assert bool(obstacle) == bool(RunStructure.find_obstacle(run))
    assert obstacle in RunStructure.find_obstacle(run)


def test_groups_share_structure_and_small_groups_split() -> None:
    free = [FusedRun(load_scenario("free", {"duration_s": 0.1})) for _ in range(LANES + 1)]
    longer = [
        FusedRun(load_scenario("free", {"duration_s": 0.2})) for _ in range(LEAST_RUNS - 1)
    ]
    plain = {"sites.m1.control": {"law": "tests.plugged_laws:Line"}}
    unfit = [FusedRun(load_scenario("free", {"duration_s": 0.1, **plain}))]
    sizes = []
    members = []
    for group in RunGroup.divide([*free, *longer, *unfit]):
        sizes.append(len(group.members))
        members += group.members
    assert sorted(members) == list(range(LANES + LEAST_RUNS + 1))
    assert sorted(sizes) == [1] * (LEAST_RUNS + 1) + [LANES]


def _has_avx2() -> bool:
    """True if the processor has vector registers of four numbers."""
    import llvmlite.binding

    return platform.machine() in ("x86_64", "AMD64") and bool(
        llvmlite.binding.get_host_cpu_features().get("avx2")
    )


@pytest.mark.long
@pytest.mark.skipif(not _has_avx2(), reason="the processor has no AVX2")
@pytest.mark.parametrize("settings", [{}, {"on_stale": GLIDE}], ids=["use", "glide"])
def test_stages_use_vector_instructions(settings: dict[str, Any]) -> None:
    """A single branch in a leaf would cost a factor of four: stage 8 alone divides eight times."""
    run = FusedRun(load_scenario("free", {"duration_s": 0.1, **settings}))
    code = LaneRun.list_code(run)[0].read_assembly()
    packed = {
        name: len(re.findall(rf"\bv{name}pd\b[^\n]*[yz]mm", code))
        for name in ("add", "sub", "mul", "div", "max", "sqrt")
    }
    arithmetic = r"\bv(?:add|sub|mul)pd\b[^\n]*[yz]mm"
    loops = [
        block
        for block in re.split(r"\n(?=\.LBB)", code)
        if len(re.findall(arithmetic, block)) > 9
    ]
    assert packed["div"] >= 8
    assert packed["add"] + packed["sub"] + packed["mul"] >= 650
    # errors and estimate; torque, record and integration; statistics
    assert len(loops) >= 3
