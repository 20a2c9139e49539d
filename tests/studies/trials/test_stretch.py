"""What is kept within a window: whatever the blocks, by the definitions of `Window`, and nothing outside."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import trilat_net
from trilat_net.core.two_link_arm import end_effector_jacobian
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.expect import WINDOW_QUANTITIES, ExpectWindow
from trilat_net.studies.record_batches import RecordBatch
from trilat_net.studies.trials.measure_run import WindowStats, measure_log, measure_virtual_run

WALL = {"kind": "wall", "point_m": [1.25, 0.0], "normal": [-2.0, 0.0], "stiffness_n_m": 2000.0}
ASKED = {key: [-1e9, 1e9] for key in WINDOW_QUANTITIES}
CHANGES = {
    "duration_s": 2.0,
    "link.delay_ms": 20.0,
    "sites.m.hands": [{"kind": "pulse", "start_s": 0.0, "end_s": 2.0, "peak_nm": [0.0, -20.0]}],
    "sites.s.environment": [{**WALL, "damping_n_s_m": 5.0}],
}
RECORDS = 200


def scenario(**changes: Any) -> Scenario:
    window = {"from_s": 0.5, "to_s": 1.5, "site": "s", **ASKED}
    return load_scenario("contact", {**CHANGES, "expect": {"windows": [window]}, **changes})


@pytest.fixture(scope="module")
def log() -> Log:
    return trilat_net.simulate(scenario())


def rows(seed: int) -> RecordBatch:
    """Two seconds at 100 Hz about the start pose, in and out of a wall."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(5, RECORDS, 2))
    vectors[0] = [-0.6, 1.8] + 0.02 * vectors[0]
    return RecordBatch(np.arange(RECORDS) * 10_000_000, *vectors, np.zeros((RECORDS, 1), dtype=np.int64))


def stretched(records: RecordBatch, cuts: list[int], **window: Any) -> dict[str, Any]:
    spec = load_scenario("contact", {**CHANGES, "sites.s.rate_hz": 100}).sites["s"]
    made = WindowStats(ExpectWindow(**{"from_s": 0.5, "to_s": 1.5, **window}), spec)
    for first, last in pairwise([0, *sorted(cuts), RECORDS]):
        if first < last:
            made.add(RecordBatch(*(column[first:last] for column in records)))
    return made.figures()


@given(seed=st.integers(0, 100), cuts=st.lists(st.integers(0, RECORDS), max_size=8))
def test_the_cut_into_blocks_has_no_influence(seed: int, cuts: list[int]) -> None:
    cut, whole = stretched(rows(seed), cuts), stretched(rows(seed), [])
    for key in WINDOW_QUANTITIES:
        assert cut[key] == pytest.approx(whole[key], rel=1e-12, abs=1e-12)


@given(seed=st.integers(0, 100), outside=st.sampled_from([slice(0, 50), slice(150, RECORDS)]))
def test_what_lies_outside_of_the_window_leaves_no_trace(seed: int, outside: slice) -> None:
    records = rows(seed)
    bent = RecordBatch(*(column.copy() for column in records))
    for column in bent[1:6]:
        column[outside] += 100.0
    assert stretched(bent, []) == stretched(records, [])


@pytest.mark.parametrize(("to_s", "known"), [(1.5, True), (2.0, True), (2.01, False), (5.0, False)])
def test_a_window_that_the_records_do_not_fill_tells_nothing(to_s: float, known: bool) -> None:
    assert bool(stretched(rows(1), [], to_s=to_s)) == known


def test_its_figures_are_what_their_definitions_say(log: Log) -> None:
    """The wall's force is the one whose torque J' F stands in the records."""
    (found,) = measure_log(log).windows
    site = log["s"]
    inside = (site.t_s >= 0.5) & (site.t_s < 1.5)
    force = np.zeros(len(site))
    for k, q in enumerate(site.q):
        J = np.array(end_effector_jacobian(np.ones(2), q))
        force[k] = -np.linalg.solve(J.T, -site.tau_x[k])[0]
    push, force = -site.tau_x[inside], force[inside]
    wanted = {
        "error_peak_rad": np.abs(site.e[inside]).max(),
        "speed_peak_rad_s": np.abs(site.qd[inside]).max(),
        "torque_peak_nm": np.abs(site.tau[inside]).max(),
        "push1_mean_nm": push[:, 0].mean(),
        "push2_mean_nm": push[:, 1].mean(),
        "wall_mean_n": force.mean(),
        "wall_deviation_n": force.std(),
        "wall_peak_n": force.max(),
        "wall_hits": np.sum((force[1:] > 1e-9) & (force[:-1] <= 1e-9)),
    }
    assert wanted["wall_hits"] >= 1
    assert {key: found[key].least for key in wanted} == pytest.approx(wanted, abs=1e-9)
    for joint, key in enumerate(("q1_rad", "q2_rad")):
        assert found[key] == (site.q[inside, joint].min(), site.q[inside, joint].max())


def test_a_run_and_its_log_have_the_same_figures(log: Log) -> None:
    (run,), (logged,) = measure_virtual_run(log.scenario).windows, measure_log(log).windows
    assert run.keys() == set(WINDOW_QUANTITIES)
    for key in WINDOW_QUANTITIES:
        assert run[key] == pytest.approx(logged[key], rel=1e-12)


def test_a_window_of_all_sites_has_the_largest_of_them(log: Log) -> None:
    everywhere = {"from_s": 0.5, "to_s": 1.5, "error_peak_rad": [0.0, 1.0], "torque_peak_nm": [0.0, 1.0]}
    (found,) = measure_virtual_run(scenario(expect={"windows": [everywhere]})).windows
    inside = {name: (log[name].t_s >= 0.5) & (log[name].t_s < 1.5) for name in log.sites}
    assert found["error_peak_rad"].most == max(np.abs(log[n].e[k]).max() for n, k in inside.items())
    assert found["torque_peak_nm"].least == max(np.abs(log[n].tau[k]).max() for n, k in inside.items())


def test_a_run_that_ended_before_measures_nothing() -> None:
    assert measure_virtual_run(scenario(**{"limits.qd_limit_rad_s": 0.05})).windows == ({},)
