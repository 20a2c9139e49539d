"""Frames of a running session show a user the data that the user's site had, and no newer data."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trilat_people.live_page.session_frames import SessionFrames
from trilat_people.live_page.session_view import SessionView
from trilat_people.live_page.terminal_watch import SessionWatch

from tests.sites.relay import RelayClock
from tests.sites.sessions import SESSION, Session
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.app.monitor import StatusRow
from trilat_net.app.running_session import RunningSession
from trilat_net.log.log_reader import Log
from trilat_net.net.bus import Bus
from trilat_net.net.connection import Connection
from trilat_net.scenario import load_scenario

FRAME_NS = 33_333_333
PEER_FIELDS = {"points", "q", "tick", "bodies", "age_ms"}
JITTER = {
    "model": "gamma",
    "delay_ms": 260.0,
    "deviation_ms": 50.0,
    "loss": 0.3,
    "loss_burst": 4.0,
}
Frames = list[dict[str, Any]]


def make_frame_collector(
    frames: Frames, site: str, *, ages: bool = True
) -> Callable[[Bus, RelayClock], None]:
    """Returns a page server without sockets, which appends the frames of a site's page to a list."""

    def look(bus: Bus, clock: RelayClock) -> None:
        view = SessionView(bus, clock, SESSION)
        pages = SessionFrames(view)
        while not view.ended:
            view.poll()
            frame = pages.make_frame()
            if frame is not None:
                frames.append(pages.describe_as(frame, site, ages=ages))
            clock.sleep_until(clock.monotonic_ns() + FRAME_NS)

    return look


def compute_points(log: Log, site: str, tick: int) -> list[Any]:
    """Returns the points of an arm at a tick, rounded as in frames."""
    q = log[site].states[tick].q if tick >= 0 else log.scenario.sites[site].q0_rad
    arm = build_arm_rows(log.scenario, site)
    points = arm.joint_positions_m(np.array([q], dtype=np.float64))[0]
    return np.round(points, 5).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("scenario", "site", "peers", "links"),
    [
        ("paper", "m1", ("m2", "s"), {"link.delay_ms": 300}),
        ("paper", "s", ("m1", "m2"), {"link.delay_ms": 300}),
        (
            "two_sites",
            "m",
            ("s",),
            {"link.model": "gamma", "link.deviation_ms": 80, "link.loss": 0.3},
        ),
        ("paper", "m1", ("m2", "s"), {"link.delay_ms": 50, "sites.m1.view.delay_ms": 300}),
        ("two_sites", "m", ("s",), {"sites.m.view": JITTER, "sites.s.rate_hz": 400}),
    ],
)
def test_peers_are_drawn_as_logged(
    tmp_path: Path, scenario: str, site: str, peers: tuple[str, ...], links: dict[str, Any]
) -> None:
    keys = {"duration_s": 2.5, "link.delay_ms": 300, **links}
    session = Session.whole(load_scenario(scenario, keys), tmp_path)
    frames: Frames = []
    session.stranger(make_frame_collector(frames, site))
    log = session.run()
    different_points = set()
    shown_ticks = log.shown(site)
    for frame in frames:
        own = frame["sites"][site]
        assert own["points"] == compute_points(log, site, own["tick"])
        assert frame["t"] == own["t"]
        for peer in peers:
            shown_peer = frame["sites"][peer]
            assert shown_peer["tick"] == shown_ticks[peer][own["tick"]]
            assert shown_peer["points"] == compute_points(log, peer, shown_peer["tick"])
            different_points.add(str(shown_peer["points"]))
    assert len(frames) > 60
    assert len(different_points) > 50
    assert frames[-1]["sites"][peers[0]]["age_ms"] >= 100.0


def test_a_user_is_shown_how_its_law_pulls(tmp_path: Path) -> None:
    """The torque without gravity compensation equals that of the shown force at the end effector."""
    keys = {"duration_s": 1.5, "arm.g_m_s2": 9.81, "sites.m1.q0_rad": [0.3, 1.2]}
    session = Session.whole(load_scenario("paper", keys), tmp_path)
    frames: Frames = []
    session.stranger(make_frame_collector(frames, "m1"))
    log = session.run()
    arm = build_arm_rows(log.scenario, "m1")
    largest_pull_n = 0.0
    for frame in frames:
        shown_master = frame["sites"]["m1"]
        record = log["m1"].states[shown_master["tick"]]
        q = np.array([record.q])
        J = arm.place_end_effector(q, np.zeros_like(q)).J[0]
        torque = np.array(record.tau) - arm.gravity_torque(q)[0]
        if np.linalg.svd(J, compute_uv=False)[-1] > 0.1 * np.linalg.norm(J):
            assert J.T @ np.array(shown_master["pull"]) == pytest.approx(torque, abs=5e-3)
            largest_pull_n = max(largest_pull_n, np.linalg.norm(shown_master["pull"]))
    assert largest_pull_n > 1.0


def test_peers_stay_until_their_record_has_come(tmp_path: Path) -> None:
    """A lost record is never replaced by a newer one, and the shown record catches up later."""
    session = Session.whole(
        load_scenario("two_sites", {"duration_s": 3.0, "link.delay_ms": 20}), tmp_path
    )
    session.lose("m", f"trilat/{SESSION}/s/state", 2_500_000_000, 3_000_000_000)
    frames: Frames = []
    session.stranger(make_frame_collector(frames, "m"))
    log = session.run()
    lags_ticks = []
    for frame in frames:
        shown_peer = frame["sites"]["s"]
        shown_master = frame["sites"]["m"]
        used_tick = log["m"].states[shown_master["tick"]].used["s"]
        lags_ticks.append(used_tick - shown_peer["tick"])
        assert shown_peer["points"] == compute_points(log, "s", shown_peer["tick"])
        if shown_peer["age_ms"] is not None:
            assert shown_peer["age_ms"] == pytest.approx(
                shown_master["tick"] - shown_peer["tick"]
            )
    assert min(lags_ticks) == 0
    assert max(lags_ticks) > 50
    assert lags_ticks[-1] == 0


def test_users_are_told_only_what_they_know(tmp_path: Path) -> None:
    keys = {"duration_s": 1.5, "rate_hz": 200, "link.delay_ms": 100}
    session = Session.whole(load_scenario("paper", keys), tmp_path)
    frames: Frames = []
    session.stranger(make_frame_collector(frames, "m1", ages=False))
    session.run()
    for frame in frames:
        assert {*frame["sites"]["s"]} == {*frame["sites"]["m2"]} == PEER_FIELDS - {"age_ms"}
        assert frame["links"] == frame["shares"] == {}
        assert {*frame} == {"t", "sites", "links", "shares", "energy", "ended", "silent_s"}
    assert frames


def test_bodies_are_as_old_as_their_arm(tmp_path: Path) -> None:
    plant = {"class": "tests.own_code:Carousel", "bodies": {"box": [0.2, 0.2, 0.1]}}
    keys = {"sites.s.plant": plant, "duration_s": 1.5, "link.delay_ms": 300}
    session = Session.whole(load_scenario("paper", keys), tmp_path)
    frames: Frames = []
    session.stranger(make_frame_collector(frames, "m1"))
    log = session.run()
    for frame in frames:
        shown_peer = frame["sites"]["s"]
        tick = shown_peer["tick"]
        recorded_bodies = [] if tick < 0 else log["s"].states[tick].bodies
        assert shown_peer["bodies"] == np.round(recorded_bodies, 5).tolist()
    assert len({str(frame["sites"]["s"]["bodies"]) for frame in frames}) > 20


@pytest.mark.parametrize("view", [{}, {"sites.m1.view": JITTER}], ids=["in use", "picture"])
def test_pages_terminals_and_programs_know_the_same(
    view: dict[str, Any], tmp_path: Path
) -> None:
    """The page of m1, `trilat watch --as m1` and `states(as_site="m1")` agree at all times."""
    keys = {"duration_s": 1.5, "rate_hz": 500, "link.delay_ms": 150, "link.loss": 0.2, **view}
    session = Session.whole(load_scenario("paper", keys), tmp_path)
    compared_sites: list[int] = []

    def look(bus: Bus, clock: RelayClock) -> None:
        watch = SessionWatch(bus, clock, SESSION, "m1")
        view = watch.view
        pages = SessionFrames(view)
        with RunningSession(SESSION, Connection(), bus, clock).states(
            as_site="m1"
        ) as find_records:
            while not view.ended:
                watch.update()
                records = find_records()
                frame = pages.make_frame()
                if frame is not None:
                    sites = pages.describe_as(frame, "m1", ages=True)["sites"]
                    assert sites["m1"]["tick"] == records["m1"].tick
                    angles = {row["site"]: row["angles"] for row in watch.rows()}
                    for name, record in records.items():
                        row = StatusRow.of_pose(name, 0.0, record.q)
                        assert sites[name]["tick"] == record.tick
                        assert angles[name] == row["angles"]
                    compared_sites.append(len(records))
                clock.sleep_until(clock.monotonic_ns() + FRAME_NS)

    session.stranger(look)
    session.run()
    assert compared_sites.count(3) > 30
