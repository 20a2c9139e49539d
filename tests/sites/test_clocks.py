"""Members on different clocks make the same run, and know their offsets; wall clocks decide nothing."""

from pathlib import Path

import pytest

from tests.sites.sessions import execute_packed, pack_log
from tests.truth import judge_link, list_members, offset_errors
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import Log
from trilat_net.scenario import load_scenario

from .relay import Relay
from .sessions import Session

S = 1_000_000_000
SKEWS = {
    "m2": (3 * S, 100_000),
    "s": (-500_000_000, -100_000),
    "recorder": (86_400 * S, 37_000),
}


def run_skewed_session(
    folder: Path,
    skews: dict[str, tuple[int, int]],
    duration_s: float,
    relay: Relay | None = None,
) -> tuple[Session, Log]:
    scenario = load_scenario("asymmetric", {"duration_s": duration_s})
    session = Session.whole(scenario, folder, relay=relay or Relay(), skews=skews)
    return session, session.run()


@pytest.fixture(scope="module")
def skewed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, Log]:
    return run_skewed_session(tmp_path_factory.mktemp("skewed"), SKEWS, 2.5)


def test_clocks_that_differ_and_drift_change_no_bit(skewed: tuple[Session, Log]) -> None:
    session, log = skewed
    assert log.complete
    assert pack_log(log) == execute_packed(session.scenario)
    assert verify_log(log).passed
    assert not compare_with_virtual(log).late


@pytest.mark.parametrize(
    "names", [("m2",), pytest.param(("m1", "recorder"), marks=pytest.mark.long)]
)
def test_any_members_clock_may_differ(names: tuple[str, ...], tmp_path: Path) -> None:
    skews = {**SKEWS, "m1": (7 * S, 60_000)}
    session, log = run_skewed_session(tmp_path, {name: skews[name] for name in names}, 0.3)
    assert log.complete
    assert pack_log(log) == execute_packed(session.scenario)
    clocks = list_members(log)
    begun_ns = {name: clock.true_ns(0) for name, clock in clocks.items()}
    # one instant, but for drift since
    assert max(begun_ns.values()) - min(begun_ns.values()) <= 200_000


def test_logged_delays_and_offsets_are_within_bounds(skewed: tuple[Session, Log]) -> None:
    """Messages take no time, so that the bound is the possible drift of the clocks, soon microseconds."""
    _, log = skewed
    for site in log.sites:
        for peer in log.scenario.peers(site):
            samples = judge_link(log, site, peer)
            assert len(samples.tick) > 2000
            assert samples.inside == 1.0
            assert samples.bound_us[-1] < 50.0
            errors = offset_errors(log, site, peer)
            assert abs(errors[-1, 1]) < 10.0
            assert abs(errors[-1, 2]) < 2.0


def test_grids_follow_the_leaders_as_logged(skewed: tuple[Session, Log]) -> None:
    _, log = skewed
    clocks = list_members(log)
    for site, drift_ppb in (("m1", 0), ("m2", 100_000), ("s", -100_000)):
        stats = log.link_stats(site)
        assert all(abs(statistics.grid_error_us) <= 150 for statistics in stats)
        assert abs(stats[-1].slew_ppb) <= 200_000
        assert stats[-1].slew_ppb == pytest.approx(drift_ppb, abs=30_000)
        last = log[site].states[-1]
        late_ns = clocks[site].true_ns(last.sent_ns) - clocks["m1"].true_ns(last.t_ns)
        assert abs(late_ns) <= 60_000


def test_members_on_other_clocks_are_reported(skewed: tuple[Session, Log]) -> None:
    session, log = skewed
    texts = [text for text in session.said if "another one" in text]
    assert any(text.startswith("m1: clock of m2: another one, offset 3.0000") for text in texts)
    assert any(text.startswith("m2: clock of s: another one, offset -3.500") for text in texts)
    setups = {event.member: event for event in log.events if event.kind == "setup"}
    assert "clock of m2: another one" in setups["s"].text
    assert setups["m2"].epoch_mono_ns == list_members(log)["m2"].epoch_ns
    assert "skewed by 3000000000 ns" in setups["m2"].clock
    assert all("turn: 0 us after the grid" in event.text for event in setups.values())


def test_on_one_clock_nothing_is_estimated(tmp_path: Path) -> None:
    session, log = run_skewed_session(tmp_path, {"recorder": SKEWS["recorder"]}, 0.2)
    assert not any(event.kind == "clock" for event in log.events)
    for site in log.sites:
        for stats in log.link_stats(site):
            assert set(stats.offset_us.values()) == set(stats.bound_us.values()) == {0}
            assert (stats.grid_error_us, stats.slew_ppb) == (0, 0)
    assert not any(
        "another one" in text for text in session.said if not text.startswith("recorder")
    )


def test_sites_on_one_clock_wake_up_in_turn(tmp_path: Path) -> None:
    _, log = run_skewed_session(tmp_path, {}, 0.2)
    setups = {event.member: event.text for event in log.events if event.kind == "setup"}
    for site, turn_us in (("m1", 0), ("m2", 166), ("s", 333)):
        assert f"turn: {turn_us} us after the grid" in setups[site]
        at_once_ns = min(state.sent_ns - state.t_ns for state in log[site].states)
        assert turn_us <= at_once_ns // 1000 < turn_us + 20


class Stepping(Relay):
    """Time whose wall clock jumps by hours, back and forth, at every reading."""

    def __init__(self) -> None:
        super().__init__()
        self.readings = 0

    def unix_ns(self) -> int:
        self.readings += 1
        return super().unix_ns() + (-1) ** self.readings * self.readings * 3600 * S


@pytest.mark.long
def test_a_stepping_wall_clock_changes_only_labels(tmp_path: Path) -> None:
    (tmp_path / "steady").mkdir()
    _, steady = run_skewed_session(tmp_path / "steady", SKEWS, 0.3)
    session, log = run_skewed_session(tmp_path, SKEWS, 0.3, Stepping())
    assert session.relay.readings > 0
    assert pack_log(log) == pack_log(steady)
    for site in log.sites:
        assert [state.rx for state in log[site].states] == [
            state.rx for state in steady[site].states
        ]
        assert [state.sent_ns for state in log[site].states] == [
            s.sent_ns for s in steady[site].states
        ]
        assert log.link_stats(site)[-1].offset_us == steady.link_stats(site)[-1].offset_us
    assert log.session["epoch_unix_ns"] != steady.session["epoch_unix_ns"]


@pytest.mark.parametrize(
    "at_ns", [1_050_000_000, pytest.param(1_250_000_000, marks=pytest.mark.long)]
)
def test_hanging_members_on_other_clocks_are_awaited(at_ns: int, tmp_path: Path) -> None:
    session = Session.whole(
        load_scenario("two_sites", {"duration_s": 0.3}), tmp_path, skews={"s": (S, 50_000)}
    )
    session.clocks["s"].stall(at_ns, 900_000_000)
    log = session.run()
    assert log.complete
    assert pack_log(log) == execute_packed(session.scenario)
