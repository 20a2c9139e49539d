"""Virtual time: the order of steps and arrivals, which the driver may not decide (L2).

A log against virtual time: fed with its arrivals, and plain (the flagship corollary of L2).
"""

import io
from collections.abc import Sequence
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.execution.deliveries import DUE, PEERS, SCENARIO, Sample, make_delivered_bytes
from tests.log.builders import edit_log_bytes, make_log, make_log_bytes, open_bytes
from trilat_net import simulate
from trilat_net.core.step.ticks import Arrival, TickRecord
from trilat_net.execution import virtual
from trilat_net.execution.virtual_comparison import compare_with_virtual, find_absent_samples
from trilat_net.execution.virtual_network import PromptNetwork
from trilat_net.log.log_reader import Log
from trilat_net.log.message_identity import compute_virtual_boot
from trilat_net.scenario import Scenario, load_scenario

Rates = tuple[int, int, int]
rates = st.sampled_from([1, 7, 100, 333, 450, 1000])


def make_small_scenario(
    rate_hz: Sequence[int], duration_s: float = 0.1, delay_ms: float = 20.0
) -> Scenario:
    changes = {
        f"sites.{name}.rate_hz": rate
        for name, rate in zip(("m1", "m2", "s"), rate_hz, strict=True)
    }
    return load_scenario(
        "free", {**changes, "duration_s": duration_s, "link.delay_ms": delay_ms}
    )


@settings(max_examples=15)
@given(rate_hz=st.tuples(rates, rates, rates))
def test_sites_step_by_time_then_scenario_order(rate_hz: Rates) -> None:
    scenario = make_small_scenario(rate_hz)
    ran = [
        (o.t_ns, scenario.names.index(site.name), o.tick)
        for site, _, o in virtual.execute_virtual(scenario)
    ]
    assert ran == sorted(ran)
    for index, name in enumerate(scenario.names):
        ticks = [tick for _, i, tick in ran if i == index]
        assert ticks == list(range(scenario.ticks(name)))
        assert scenario.ticks(name) == max(1, round(Fraction(1, 10) * rate_hz[index]))


@settings(max_examples=15)
@given(rate_hz=st.tuples(rates, rates, rates))
def test_every_sample_arrives_once_right_after_its_stamp(rate_hz: Rates) -> None:
    scenario = make_small_scenario(rate_hz)
    stamps: dict[tuple[str, int], int] = {}
    ran = list(virtual.execute_virtual(scenario))
    for site, _, output in ran:
        stamps[site.name, output.tick] = output.t_ns
    for site, arrivals, output in ran:
        for arrival in arrivals:
            stamp = stamps[site.peers[arrival.peer], arrival.tick]
            assert stamp < output.t_ns
            assert output.tick == 0 or stamp >= stamps[site.name, output.tick - 1]
            assert arrival.latency_us == (output.t_ns - stamp) // 1000


class ScatteredNetwork(PromptNetwork):
    """Delivers each sample some ticks later than possible, in any order, but before it is due."""

    def __init__(self, scenario: Scenario, slack: Sequence[int]) -> None:
        super().__init__({name: spec.rate_hz for name, spec in scenario.sites.items()})
        self._held: dict[str, list[tuple[int, int, Arrival]]] = {
            name: [] for name in scenario.names
        }
        self._slack = slack

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        held = self._held[receiver]
        for arrival in super().deliver(receiver, k):
            slack = self._slack[(arrival.tick + 3 * arrival.peer) % len(self._slack)]
            held.append((k + slack, -arrival.tick, arrival))
        held.sort(key=lambda entry: entry[:2])
        now = [entry for entry in held if entry[0] <= k]
        del held[: len(now)]
        return [arrival for _, _, arrival in now]


def without_arrivals(ran: Sequence[virtual.SiteTick]) -> list[TickRecord]:
    return [stepped.output._replace(rx_crc=0) for stepped in ran]


@settings(max_examples=8)
@given(slack=st.lists(st.integers(0, 17), min_size=1, max_size=12))
def test_early_samples_make_the_network_irrelevant(slack: list[int]) -> None:
    scenario = make_small_scenario((1000, 1000, 1000))
    scattered = virtual.execute_virtual(scenario, ScatteredNetwork(scenario, slack))
    assert without_arrivals(list(scattered)) == without_arrivals(
        list(virtual.execute_virtual(scenario))
    )


def test_overdue_samples_change_the_run() -> None:
    scenario = make_small_scenario((1000, 1000, 1000))
    late = list(virtual.execute_virtual(scenario, ScatteredNetwork(scenario, [0, 25])))
    assert without_arrivals(late) != without_arrivals(list(virtual.execute_virtual(scenario)))
    assert any(sum(c.late for c in site.counts()) for site, _, _ in late)


def test_records_show_whether_limits_held() -> None:
    fine = io.BytesIO()
    wild = io.BytesIO()
    assert virtual.write_virtual_log(make_small_scenario((1000,) * 3), fine)
    assert not virtual.write_virtual_log(
        load_scenario("free", {"limits.qd_limit_rad_s": 0.3}), wild
    )
    assert [e.kind for e in open_bytes(fine.getvalue()).events] == ["end"] * 3
    kinds = [(e.member, e.kind) for e in open_bytes(wild.getvalue()).events]
    assert "diverged" in {kind for _, kind in kinds}
    assert [kind for _, kind in kinds].count("end") == 3


def test_simulate_applies_overrides() -> None:
    log = simulate("paper", set={"control.Kd": 5, "duration_s": 0.05})
    assert log.scenario.sites["s"].control.Kd == (5.0, 5.0)
    assert (log.driver, len(log["s"])) == ("virtual", 50)
    assert (
        log["s"].q.tolist()
        == simulate("paper", ["control.Kd=5", "duration_s=0.05"])["s"].q.tolist()
    )


@pytest.mark.parametrize("site", ["m1", "s"])
def test_virtual_boots_depend_on_scenario_and_name(site: str) -> None:
    scenario = load_scenario("paper")
    other = load_scenario("paper", {"seed": 2})
    same = load_scenario("paper")
    boot = compute_virtual_boot(scenario.sha256, site)
    assert boot == compute_virtual_boot(same.sha256, site)
    assert boot != compute_virtual_boot(other.sha256, site)
    assert boot != compute_virtual_boot(scenario.sha256, "m2")


def make_delivered_log(delays: dict[Sample, int]) -> Log:
    return open_bytes(make_delivered_bytes(delays))


links = st.tuples(st.sampled_from(SCENARIO.names), st.integers(0, 1), st.integers(0, 80))


@settings(max_examples=10)
@given(delays=st.dictionaries(links, st.integers(1, DUE), max_size=30))
def test_runs_without_late_samples_equal_virtual_time(
    delays: dict[Sample, int],
) -> None:
    twins = compare_with_virtual(make_delivered_log(delays))
    assert twins.late == []
    assert twins.fed == (360, 360, None)
    assert twins.plain == (360, 360, None)


@settings(max_examples=10)
@given(delays=st.dictionaries(links, st.integers(1, 39), min_size=1, max_size=30))
def test_fed_virtual_time_always_equals_its_log(
    delays: dict[Sample, int],
) -> None:
    log = make_delivered_log(delays)
    twins = compare_with_virtual(log)
    assert twins.fed == (360, 360, None)
    expected = {
        (receiver, peer, tick) for (receiver, peer, tick), way in delays.items() if way > DUE
    }
    assert {
        (late.site, PEERS[late.site].index(late.peer), late.tick) for late in twins.late
    } == expected
    if twins.plain.first is not None:
        assert twins.plain.first.tick >= min(late.due_tick for late in twins.late)


def test_plain_virtual_time_differs_from_late_samples() -> None:
    log = make_delivered_log({("m2", 1, 40): 25})
    (late,) = find_absent_samples(log)
    assert late == ("m2", "s", 40, 60, 65)
    assert str(late) == "sample 40 of s was due at tick 60 of m2 and came at tick 65"
    twins = compare_with_virtual(log)
    assert twins.plain.first is not None
    assert twins.plain.first[:2] == ("m2", 60)
    assert 0 < twins.plain.identical < twins.plain.records == 360


def test_an_overtaken_late_sample_is_harmless() -> None:
    """The sample is missed for one tick; from then on the newest is in use, but the state has moved."""
    twins = compare_with_virtual(make_delivered_log({("m1", 0, 30): 39}))
    assert [sample.tick for sample in twins.late] == [30]
    assert twins.plain.first is not None
    assert twins.plain.first[:2] == ("m1", 50)
    assert twins.plain.first.field.startswith("q_des")


@pytest.mark.parametrize("name", ["paper", "asymmetric", "two_sites", "six_joints"])
def test_virtual_logs_equal_virtual_time(name: str) -> None:
    log = make_log(name, {"duration_s": 0.5})
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

    twins = compare_with_virtual(
        open_bytes(edit_log_bytes(make_log_bytes("paper"), record=record))
    )
    for twin in (twins.fed, twins.plain):
        assert twin.first is not None
        assert twin.first[:3] == ("m2", 70, "theta_hat[3]")
        assert twin.identical == twin.records - 1


@pytest.mark.parametrize("entry", [[70_000, 3, 0], [-1, 3, 0], [0, 2**58, 0], [0, -5, 0]])
@pytest.mark.parametrize("gap", [range(0), range(5, 80)])
def test_foreign_samples_are_never_late(entry: list[int], gap: range) -> None:
    """This holds also if so many records are missing that no arrivals are assumed."""

    def record(r: dict) -> dict | None:
        if (r["site"], r["tick"]) == ("s", 90):
            r["rx"].append(entry)
        return None if r["site"] == "s" and r["tick"] in gap else r

    twins = compare_with_virtual(
        open_bytes(edit_log_bytes(make_log_bytes("paper"), record=record))
    )
    assert twins.absent == []
    assert twins.plain.first is None


def test_twins_without_hands_are_free() -> None:
    log = make_log("paper", {"duration_s": 1.2})
    twin = virtual.SimulatedLog.without_operators(log)
    assert (twin["m1"].tau_x == 0.0).all()
    assert (log["m1"].tau_x[1100:] < 0.0).all()
    assert twin["m1"].q[:1000].tolist() == log["m1"].q[:1000].tolist()
