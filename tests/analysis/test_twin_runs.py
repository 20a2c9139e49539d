"""A twin equals the run, except for the effect of its push."""

import math
from pathlib import Path

import numpy as np
import pytest

import trilat_net as tn
from tests.certificate.adversaries import p_d, two_pairs
from trilat_net.analysis.twins.twin_growth import TwinGrowth
from trilat_net.analysis.twins.twin_runs import LARGEST, Push, Twins
from trilat_net.errors import NotRepeatable, UsageError
from trilat_net.scenario import Scenario, load_scenario

GOLDEN = Path(__file__).parents[1] / "golden"
REST = {f"sites.{site}.q0_rad": [0.3, 0.5] for site in ("m1", "m2", "s")}
"""Arms that are at rest from the beginning: what is left is linear."""


def make_rest_scenario(d: float) -> Scenario:
    return load_scenario("p_d_margin", {"control.d": d, **REST})


def rate_per_s(scenario: Scenario, twins: Twins) -> float:
    return TwinGrowth.of_twins(scenario, twins, 0.0, math.inf).pushes[0].rate_per_s


@pytest.mark.parametrize(("d", "seconds"), [(0.5, 40.0), (2.0, 40.0), (3.0, 40.0)])
def test_linear_differences_obey_their_root(d: float, seconds: float) -> None:
    scenario = make_rest_scenario(d)
    twins = Twins.of_scenario(scenario, [Push.parse(scenario, "m1.q1", 1e-7)], seconds)
    roots = tn.linear("p_d_margin", {"control.d": d}, pose=(0.3, 0.5), ports=False).to_dict()
    root_per_s = roots["as_computed"]["roots"][0]["re_per_s"]
    assert rate_per_s(scenario, twins) == pytest.approx(root_per_s, rel=0.02)


def test_a_zero_push_changes_no_bit() -> None:
    scenario = load_scenario("paper")
    by = np.zeros((3, 2))
    twins = Twins.of_scenario(
        scenario, [Push("nothing", "q", by), Push("nothing later", "qd", by, 1.3)], 3.0
    )
    assert not np.isfinite([path.largest for path in twins.paths]).any()
    assert twins.speed.max() > 0.1


@pytest.mark.parametrize("name", ["live-4g", "live-paper"])
def test_a_live_run_is_repeated_bit_for_bit(name: str) -> None:
    """The run is repeated with its recorded arrivals: late, lost and early samples."""
    log = tn.open_log(GOLDEN / f"{name}.mcap")
    twins = Twins.of_log(log, Push.choose(log.scenario, 1))
    assert twins.same
    assert np.isfinite(twins.paths[0].largest[1:-1]).all()


def test_pushes_never_reach_other_closed_groups() -> None:
    scenario = two_pairs((p_d(2.0), p_d(2.0)), (0.1, 0.3, 0.2, 0.6))
    twins = Twins.of_scenario(scenario, [Push.parse(scenario, "a.q1")], 4.0)
    reached = np.isfinite(twins.paths[0].largest).any(axis=0)
    assert reached.tolist() == [True] * 4 + [False] * 4


@pytest.mark.long
def test_rescaling_a_difference_keeps_its_rate() -> None:
    scenario = make_rest_scenario(0.5)
    free = Push.parse(scenario, "m1.q1", 1e-9)._replace(largest=math.inf)
    often = free._replace(largest=2e-9)
    twins = Twins.of_scenario(scenario, [free, often], 100.0)
    assert not twins.paths[0].scale.any()
    assert np.count_nonzero(np.diff(twins.paths[1].scale)) >= 3
    first, second = (path.largest[100:-2].max(axis=1) for path in twins.paths)
    assert first == pytest.approx(second, abs=1e-3)


def test_dying_differences_end_or_are_repeated() -> None:
    scenario = make_rest_scenario(3.0)
    once = Push.parse(scenario, "m1.qd2", 1e-9)
    twins = Twins.of_scenario(scenario, [once, once._replace(again=True)], 60.0)
    ended, anew = twins.paths
    assert ended.died is not None
    assert not np.isfinite(ended.largest[ended.died :]).any()
    assert ended.largest[ended.died - 1].max() >= math.log(1e-12)
    assert anew.died is None
    assert len(anew.pushed) > 1


def test_a_twin_beyond_its_limits_is_reported() -> None:
    """The run itself stays within the limits; a twin with a large enough push does not."""
    log = tn.simulate("paper", {"limits.qd_limit_rad_s": 1.2}, duration_s=10)
    twin_report = tn.twin(log, 1, {"m1.q1": 0.9, "q": 1e-3})
    far, near = twin_report.growth.pushes
    assert log.diverged_s is None
    assert far.ended_s is not None
    assert 1.0 < far.ended_s < 2.0
    assert "makes the run diverge in " in twin_report.describe(far)
    assert near.ended_s is None


def test_a_push_acts_at_its_instant() -> None:
    scenario = load_scenario("two_sites")
    twins = Twins.of_scenario(scenario, [Push.parse(scenario, "s.q", 1e-3, at_s=1.25)], 2.0)
    path = twins.paths[0]
    assert path.pushed == (25,)
    assert not np.isfinite(path.largest[:25]).any()
    # m has not heard of it yet
    assert np.isfinite(path.largest[25]).tolist() == [
        False,
        False,
        True,
        True,
    ]
    assert path.push.largest == math.inf > LARGEST
    with pytest.raises(NotRepeatable, match="within the run"):
        Twins.of_scenario(scenario, [path.push._replace(at_s=2.0)], 2.0)


@pytest.mark.parametrize(
    ("target", "name", "pushed"),
    [
        ("m1.q2", "1e-06 rad at m1 joint 2", [(0, 1)]),
        ("s.qd1", "1e-06 rad/s at s joint 1", [(2, 0)]),
        ("m2.theta3", "1e-06 of m2 estimate 3", [(1, 2)]),
        ("m2.q", "1e-06 rad at all joints of m2", [(1, 0), (1, 1)]),
        ("qd", "1e-06 rad/s at all joints", [(i, j) for i in range(3) for j in range(2)]),
        ("theta", "1e-06 of all estimates", [(i, j) for i in range(3) for j in range(5)]),
    ],
)
def test_a_push_is_named_by_words(
    target: str, name: str, pushed: list[tuple[int, int]]
) -> None:
    push = Push.parse(load_scenario("paper"), target)
    assert push.name == name
    assert [tuple(at) for at in np.argwhere(push.by).tolist()] == pushed
    assert np.abs(push.by).max() <= 1e-6


@pytest.mark.parametrize(
    "target", ["", "m1", "m1.q0", "m1.q3", "m1.theta6", "m4.q1", "q1", "m1.q1.q1", "m1.tau1"]
)
def test_impossible_pushes_name_the_possible_ones(target: str) -> None:
    with pytest.raises(UsageError, match=r"no such number; .* m1 \(2 joints, 5 estimates\)"):
        Push.parse(load_scenario("paper"), target)


@pytest.mark.parametrize("size", [0.0, math.nan, math.inf, 1e-12, -2.0])
def test_an_invalid_size_is_refused(size: float) -> None:
    with pytest.raises(UsageError, match="from 1e-11 to 1"):
        Push.parse(load_scenario("paper"), "m1.q1", size)
