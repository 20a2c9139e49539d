"""A log against virtual time: fed with its arrivals, and plain (the flagship corollary of L2)."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.execution.deliveries import DUE, PEERS, SCENARIO, Sample, delivered
from tests.log_editing import edited, opened, recorded
from trilat_net.execution.virtual_comparison import (
    compare_with_virtual,
    find_absent_samples,
    simulate_without_operators,
)
from trilat_net.log.log_reader import Log


def opened_delivered(delays: dict[Sample, int]) -> Log:
    return opened(delivered(delays))


links = st.tuples(st.sampled_from(SCENARIO.names), st.integers(0, 1), st.integers(0, 80))


@settings(max_examples=10)
@given(delays=st.dictionaries(links, st.integers(1, DUE), max_size=30))
def test_a_run_without_late_samples_equals_plain_virtual_time(delays: dict[Sample, int]) -> None:
    twins = compare_with_virtual(opened_delivered(delays))
    assert twins.late == []
    assert twins.fed == (360, 360, None)
    assert twins.plain == (360, 360, None)


@settings(max_examples=10)
@given(delays=st.dictionaries(links, st.integers(1, 39), min_size=1, max_size=30))
def test_fed_with_a_logs_arrivals_virtual_time_equals_it_always(delays: dict[Sample, int]) -> None:
    log = opened_delivered(delays)
    twins = compare_with_virtual(log)
    assert twins.fed == (360, 360, None)
    expected = {(receiver, peer, tick) for (receiver, peer, tick), way in delays.items() if way > DUE}
    assert {(late.site, PEERS[late.site].index(late.peer), late.tick) for late in twins.late} == expected
    if twins.plain.first is not None:
        assert twins.plain.first.tick >= min(late.due_tick for late in twins.late)


def test_plain_virtual_time_differs_from_the_first_late_sample_on() -> None:
    log = opened_delivered({("m2", 1, 40): 25})
    (late,) = find_absent_samples(log)
    assert late == ("m2", "s", 40, 60, 65)
    assert str(late) == "sample 40 of s was due at tick 60 of m2 and came at tick 65"
    twins = compare_with_virtual(log)
    assert twins.plain.first is not None
    assert twins.plain.first[:2] == ("m2", 60)
    assert 0 < twins.plain.identical < twins.plain.records == 360


def test_an_overtaken_late_sample_is_counted_and_harmless() -> None:
    """It is missed for one tick; from then on the newest is in use as ever, but the state has moved."""
    twins = compare_with_virtual(opened_delivered({("m1", 0, 30): 39}))
    assert [sample.tick for sample in twins.late] == [30]
    assert twins.plain.first is not None
    assert twins.plain.first[:2] == ("m1", 50)
    assert twins.plain.first.field.startswith("q_des")


@pytest.mark.parametrize("name", ["paper", "asymmetric", "two_sites"])
def test_a_virtual_log_equals_virtual_time_both_ways(name: str) -> None:
    log = opened(recorded(name, {"duration_s": 0.5}))
    twins = compare_with_virtual(log)
    assert twins.late == []
    for twin in (twins.fed, twins.plain):
        assert (twin.records, twin.first) == (500 * len(log.sites), None)
        assert twin.identical == twin.records


def test_a_changed_log_does_not_equal_virtual_time() -> None:
    def record(r: dict) -> dict:
        if (r["site"], r["tick"]) == ("m2", 70):
            r["theta_hat"][3] += 1e-15
        return r

    twins = compare_with_virtual(opened(edited(recorded("paper"), record=record)))
    for twin in (twins.fed, twins.plain):
        assert twin.first is not None
        assert twin.first[:3] == ("m2", 70, "theta_hat[3]")
        assert twin.identical == twin.records - 1


def test_the_twin_without_hands_has_nobody_at_the_arms() -> None:
    log = opened(recorded("paper", {"duration_s": 1.2}))
    twin = simulate_without_operators(log)
    assert (twin["m1"].tau_x == 0.0).all()
    assert (log["m1"].tau_x[1100:] < 0.0).all()
    assert twin["m1"].q[:1000].tolist() == log["m1"].q[:1000].tolist()
