"""Frames of a running session: what a page shows as one site is what that site had, and nothing newer."""

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
from trilat_net.analysis.arm_rows import build_arm_rows, joint_positions_m
from trilat_net.app.monitor import StatusRow
from trilat_net.app.running_session import RunningSession
from trilat_net.log.log_reader import Log
from trilat_net.net.bus import Bus
from trilat_net.net.connection import Connection
from trilat_net.scenario import load_scenario

FRAME_NS = 33_333_333
KNOWN_OF_PEERS = {"points", "q", "tick", "bodies", "age_ms"}
JITTER = {
    "model": "gamma",
    "delay_ms": 260.0,
    "deviation_ms": 50.0,
    "loss": 0.3,
    "loss_burst": 4.0,
}
Frames = list[dict[str, Any]]


def looking(
    frames: Frames, site: str, *, ages: bool = True
) -> Callable[[Bus, RelayClock], None]:
    """A page's server without sockets, which keeps what it would show as a site."""

    def look(bus: Bus, clock: RelayClock) -> None:
        view = SessionView(bus, clock, SESSION)
        pages = SessionFrames(view)
        while not view.ended:
            view.poll()
            if (frame := pages.make_frame()) is not None:
                frames.append(pages.describe_as(frame, site, ages=ages))
            clock.sleep_until(clock.monotonic_ns() + FRAME_NS)

    return look


def drawn(log: Log, site: str, tick: int) -> list[Any]:
    """The points of an arm at a tick, as frames round them."""
    q = log[site].states[tick].q if tick >= 0 else log.scenario.sites[site].q0_rad
    points = joint_positions_m(log.scenario.arms[site], np.array([q], dtype=np.float64))[0]
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
    session.stranger(looking(frames, site))
    log = session.run()
    moved = set()
    shown = log.shown(site)
    for frame in frames:
        own = frame["sites"][site]
        assert own["points"] == drawn(log, site, own["tick"])
        assert frame["t"] == own["t"]
        for peer in peers:
            known = frame["sites"][peer]
            assert known["tick"] == shown[peer][own["tick"]]
            assert known["points"] == drawn(log, peer, known["tick"])
            moved.add(str(known["points"]))
    assert len(frames) > 60
    assert len(moved) > 50
    assert frames[-1]["sites"][peers[0]]["age_ms"] >= 100.0


def test_a_user_is_shown_how_its_law_pulls(tmp_path: Path) -> None:
    """The torque beyond what carries the arm does the work of a force at its end, N."""
    keys = {"duration_s": 1.5, "arm.g_m_s2": 9.81, "sites.m1.q0_rad": [0.3, 1.2]}
    session = Session.whole(load_scenario("paper", keys), tmp_path)
    frames: Frames = []
    session.stranger(looking(frames, "m1"))
    log = session.run()
    arm = build_arm_rows(log.scenario, "m1")
    largest = 0.0
    for own in (frame["sites"]["m1"] for frame in frames):
        record = log["m1"].states[own["tick"]]
        q = np.array([record.q])
        J = arm.place_end_effector(q, np.zeros_like(q)).J[0]
        torque = np.array(record.tau) - arm.gravity_torque(q)[0]
        if np.linalg.svd(J, compute_uv=False)[-1] > 0.1 * np.linalg.norm(J):
            assert J.T @ np.array(own["pull"]) == pytest.approx(torque, abs=5e-3)
            largest = max(largest, np.linalg.norm(own["pull"]))
    assert largest > 1.0


def test_peers_stay_until_their_record_has_come(tmp_path: Path) -> None:
    """Never a newer one, and the one in use again once it can be had."""
    session = Session.whole(
        load_scenario("two_sites", {"duration_s": 3.0, "link.delay_ms": 20}), tmp_path
    )
    session.lose("m", f"trilat/{SESSION}/s/state", 2_500_000_000, 3_000_000_000)
    frames: Frames = []
    session.stranger(looking(frames, "m"))
    log = session.run()
    behind = []
    for frame in frames:
        known, own = frame["sites"]["s"], frame["sites"]["m"]
        behind.append(log["m"].states[own["tick"]].used["s"] - known["tick"])
        assert known["points"] == drawn(log, "s", known["tick"])
        if known["age_ms"] is not None:
            assert known["age_ms"] == pytest.approx(own["tick"] - known["tick"])
    assert min(behind) == 0
    assert max(behind) > 50
    assert behind[-1] == 0


def test_users_are_told_only_what_they_know(tmp_path: Path) -> None:
    keys = {"duration_s": 1.5, "rate_hz": 200, "link.delay_ms": 100}
    session = Session.whole(load_scenario("paper", keys), tmp_path)
    frames: Frames = []
    session.stranger(looking(frames, "m1", ages=False))
    session.run()
    for frame in frames:
        assert {*frame["sites"]["s"]} == {*frame["sites"]["m2"]} == KNOWN_OF_PEERS - {"age_ms"}
        assert frame["links"] == frame["shares"] == {}
        assert {*frame} == {"t", "sites", "links", "shares", "energy", "ended", "silent_s"}
    assert frames


def test_bodies_are_as_old_as_their_arm(tmp_path: Path) -> None:
    plant = {"class": "tests.own_code:Carousel", "bodies": {"box": [0.2, 0.2, 0.1]}}
    keys = {"sites.s.plant": plant, "duration_s": 1.5, "link.delay_ms": 300}
    session = Session.whole(load_scenario("paper", keys), tmp_path)
    frames: Frames = []
    session.stranger(looking(frames, "m1"))
    log = session.run()
    for frame in frames:
        known = frame["sites"]["s"]
        there = [] if known["tick"] < 0 else log["s"].states[known["tick"]].bodies
        assert known["bodies"] == np.round(there, 5).tolist()
    assert len({str(frame["sites"]["s"]["bodies"]) for frame in frames}) > 20


@pytest.mark.parametrize("view", [{}, {"sites.m1.view": JITTER}], ids=["in use", "picture"])
def test_pages_terminals_and_programs_know_the_same(
    view: dict[str, Any], tmp_path: Path
) -> None:
    """A page as m1 beside `trilat watch --as m1` and `states(as_site="m1")`, at the same moments."""
    keys = {"duration_s": 1.5, "rate_hz": 500, "link.delay_ms": 150, "link.loss": 0.2, **view}
    session = Session.whole(load_scenario("paper", keys), tmp_path)
    compared: list[int] = []

    def look(bus: Bus, clock: RelayClock) -> None:
        watch = SessionWatch(bus, clock, SESSION, "m1")
        view = watch.view
        pages = SessionFrames(view)
        with RunningSession(SESSION, Connection(), bus, clock).states(as_site="m1") as find:
            while not view.ended:
                watch.update()
                found = find()
                if (frame := pages.make_frame()) is not None:
                    sites = pages.describe_as(frame, "m1", ages=True)["sites"]
                    assert sites["m1"]["tick"] == found["m1"].tick
                    ticks = {name: sites[name]["tick"] for name in found}
                    assert ticks == {name: record.tick for name, record in found.items()}
                    rows = {row["site"]: row["angles"] for row in watch.rows()}
                    assert {name: rows[name] for name in found} == {
                        name: StatusRow.of_pose(name, 0.0, record.q)["angles"]
                        for name, record in found.items()
                    }
                    compared.append(len(found))
                clock.sleep_until(clock.monotonic_ns() + FRAME_NS)

    session.stranger(look)
    session.run()
    assert compared.count(3) > 30
