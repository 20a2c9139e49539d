"""An external arm: its measurements are the record, and without them the session stops."""

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sites.external_arm import (
    HELD_SILENCE_NS,
    MEASUREMENTS_KEPT,
    SILENCE_LIMIT_NS,
    STARTS_KEPT,
    SWITCH_SILENCE_NS,
    DeadManSwitch,
    ExternalArm,
)
from tests.core.builders import make_site_setup
from tests.log.builders import rewrite_log
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from tests.scenario.builders import make_six_joint_scenario
from tests.sites.sessions import reach_session
from trilat_net.analysis.file_overview import info, summarise_run
from trilat_net.analysis.link_summary import LinkSummary
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import LifeReason, Mode, TickInput
from trilat_net.errors import ScenarioError, SessionError
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.findings import CheckReport
from trilat_net.log.log_reader import Log
from trilat_net.net import topics
from trilat_net.net.arm_client import FRESH_NS, ArmClient, SwitchClient
from trilat_net.net.bus import Bus, StampingRing
from trilat_net.net.messages import VERSION, Event, State
from trilat_net.net.requests import ArmEnable, ArmMeasurement
from trilat_net.net.wire import encode
from trilat_net.presentation.page import render_report
from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import SESSION, Session

ARM = {
    "sites.s.plant": "external",
    "sites.s.arm.known": False,
    "sites.s.on_stale.action": "glide",
    "sites.s.on_stale.align_limit_rad": 3.0,
    "sites.s.limits.tau_rate_limit_nm_s": 2000.0,
    "sites.s.limits.qd_des_limit_rad_s": 5.0,
    "sites.s.limits.q_min_rad": -3.0,
    "sites.s.limits.q_max_rad": 3.0,
}
OUTSIDE = {"duration_s": 1.0, **ARM}
PERIOD_NS = 1_000_000
A_SECOND = 1_000_000_000


class Pendulum:
    """Uncoupled joints with friction, as an external arm."""

    def __init__(self, q: Sequence[float]) -> None:
        self.q = list(q)
        self.qd = [0.0] * len(q)

    def move(self, tau: tuple[float, ...] | None) -> None:
        for i in range(len(self.q)):
            push = 0.0 if tau is None else tau[i] - 3.0 * math.sin(self.q[i])
            self.qd[i] += 1e-3 * (push - 2.0 * self.qd[i] - 0.5 * math.tanh(50.0 * self.qd[i]))
            self.q[i] += 1e-3 * self.qd[i]


Act = Callable[[Bus, RelayClock], None]


def make_arm_program(
    sent: list[list[float]],
    torques: list[tuple[float, ...]],
    until_ns: int = 2**62,
    arm: Pendulum | None = None,
    senses: bool = False,
    poses: list[tuple[int, list[float]]] | None = None,
) -> Act:
    """The program of an arm; `poses` collects its times and poses, and a program with `poses`
    has brakes.
    """
    body = arm or Pendulum((0.3, -0.1))

    def drive(bus: Bus, clock: RelayClock) -> None:
        with ArmClient(bus, clock, SESSION, "s") as port:
            next_ns = clock.monotonic_ns()
            while not port.over and next_ns < until_ns:
                felt = [math.sin(7.0 * q) for q in body.q] if senses else []
                port.send(body.q, body.qd, felt)
                sent.append([*body.q, *body.qd, *felt])
                tau = port.torque()
                torques.extend([] if tau is None else [tau])
                if tau is None and poses is not None:
                    body.qd = [0.0] * len(body.q)
                else:
                    body.move(tau)
                if poses is not None:
                    poses.append((clock.monotonic_ns(), list(body.q)))
                next_ns += PERIOD_NS
                clock.sleep_until(next_ns)

    return drive


def make_external_session(
    folder: Path, act: Act | None, **overrides: object
) -> tuple[Session, dict[str, object]]:
    scenario = load_scenario("two_sites", {**OUTSIDE, **overrides})
    session = Session.whole(scenario, folder, ends={})
    if act is not None:
        session.stranger(act, at_ns=A_SECOND + 200_250_000)
    return session, session.ends


def test_external_measurements_are_the_record_and_drive(tmp_path: Path) -> None:
    sent: list[list[float]] = []
    torques: list[tuple[float, ...]] = []
    session, ends = make_external_session(tmp_path, make_arm_program(sent, torques))
    log = session.run()
    assert ends == {"m": 0, "s": 0}
    records = [[*state.q, *state.qd] for state in log["s"].states]
    # every measurement, in order, to the bit
    assert records in [
        sent[n : n + 1000] for n, record_sent in enumerate(sent) if record_sent == records[0]
    ]
    taus = [tuple(state.tau) for state in log["s"].states]
    assert [tau for tau in torques if tau in taus] == torques
    assert set(taus[:-1]) <= set(torques)
    moved = abs(log["s"].q[-1] - log["s"].q[0]).max()
    assert moved > 0.05
    assert_reproduced(log)
    assert any("waiting for its arm on trilat/t/s/measured" in line for line in session.said)
    assert any("0.3 rad off q0_rad" in line for line in session.said)
    assert [event.member for event in log.events if event.kind == "arm"] == ["s"]


def assert_reproduced(log: Log) -> None:
    """Asserts that the log is executed again, and equals virtual time fed with the log, bit for bit."""
    assert log.complete
    verdict = verify_log(log)
    assert verdict.whole_run
    assert verdict.identical == verdict.records == sum(len(log[name]) for name in log.sites)
    assert compare_with_virtual(log).fed.identical == verdict.records


@pytest.mark.long
def test_external_arms_may_send_measured_torques(tmp_path: Path) -> None:
    """The measured tau_x is the record's to the bit, goes to the peers, and enters the repeated
    execution.
    """
    changes = {**ARM, "duration_s": 0.3}
    Site(make_six_joint_scenario(**changes).setup("s")).step(
        TickInput(0)
    )  # compiles, before anybody waits
    sent: list[list[float]] = []
    session = Session.whole(make_six_joint_scenario(**changes), tmp_path, ends={})
    start = make_six_joint_scenario().sites["s"].q0_rad
    session.stranger(
        make_arm_program(sent, [], arm=Pendulum(start), senses=True),
        at_ns=A_SECOND + 200_250_000,
    )
    log = session.run()
    assert set(session.ends.values()) == {0}
    records = [[*state.q, *state.qd, *state.tau_x] for state in log["s"].states]
    assert records in [
        sent[n : n + 300] for n, record_sent in enumerate(sent) if record_sent == records[0]
    ]
    assert abs(log["s"].tau_x).min(axis=0).max() > 0.0
    assert_reproduced(log)


def test_arms_of_other_joint_numbers_are_refused(tmp_path: Path) -> None:
    scenario = make_six_joint_scenario(**ARM)
    session = Session(scenario, tmp_path / "run.mcap")
    session.stranger(
        make_arm_program([], [], until_ns=3 * A_SECOND, arm=Pendulum((0.0,) * 7)),
        at_ns=A_SECOND,
    )

    def alone(clock: RelayClock) -> None:
        with pytest.raises(SessionError, match=r"dropped: \d+ of 7 joints; the scenario has 6"):
            session.live("s", clock)

    session.relay.add("s", alone)
    session.play()
    assert (
        sum(
            "its arm sends measurements of 7 joints; the scenario has 6" in line
            for line in session.said
        )
        == 1
    )


def test_silent_arms_are_held_then_in_fault(tmp_path: Path) -> None:
    session, ends = make_external_session(
        tmp_path, make_arm_program([], [], until_ns=A_SECOND + 1_300_000_000)
    )
    log = session.run()
    assert ends == {"m": 0, "s": 0}
    modes = log["s"].mode
    last = int(np.flatnonzero(np.any(np.diff(log["s"].q, axis=0), axis=1))[-1]) + 1
    assert set(modes[last : last + 28]) == {"return"}  # on its way to its peer
    assert set(modes[last + 32 : last + 199]) == {"hold"}
    assert set(modes[last + 202 :]) == {"fault"}
    assert len(log["s"]) == 1000
    assert any(
        re.search("s is in FAULT from .*: its arm is silent", event.text)
        for event in log.events
    )
    assert_reproduced(log)


@pytest.mark.parametrize(
    "frozen_s", [0.3, *(pytest.param(s, marks=pytest.mark.long) for s in (1.0, 3.0, 10.0))]
)
def test_frozen_sites_catch_up_nothing(frozen_s: float, tmp_path: Path) -> None:
    poses: list[tuple[int, list[float]]] = []
    at_ns = 4 * A_SECOND
    scenario = load_scenario("two_sites", {**OUTSIDE, "duration_s": 3.5 + frozen_s})
    session = Session.whole(scenario, tmp_path, ends={})
    session.stranger(make_arm_program([], [], poses=poses), at_ns=A_SECOND + 200_250_000)
    session.clocks["s"].stall(at_ns, int(frozen_s * A_SECOND))
    log = session.run()
    assert session.ends == {"m": 0, "s": 0}
    part = log["s"]
    missed = round(1e3 * frozen_s)
    (jump,) = np.flatnonzero(np.diff(part.tick) > 1)
    assert abs(int(part.tick[jump + 1] - part.tick[jump]) - missed) <= 1
    assert part.skipped == int(part.tick[jump + 1] - part.tick[jump]) - 1
    assert set(part.mode[jump + 1 :]) == {"fault"}
    held = next(q for now_ns, q in poses if now_ns >= at_ns)
    assert (
        max(
            abs(a - b)
            for now_ns, q in poses
            if now_ns >= at_ns
            for a, b in zip(q, held, strict=True)
        )
        < 0.05
    )
    before = part.theta_hat[jump]
    after = part.theta_hat[-1]
    assert np.abs(after - before).max() <= 0.01 * np.abs(before).max()
    assert np.abs(np.diff(part.tau, axis=0)).max() <= 2.0 * (1.0 + 1e-9)  # 2000 N m/s
    assert log["m"].mode[-1] in ("run", "hold", "return")
    assert_reproduced(log)


def test_skipped_ticks_count_as_missing_nowhere(tmp_path: Path) -> None:
    """Ticks that a late site skipped are named as skipped by sites, recorder, file and links."""
    scenario = load_scenario("two_sites", {**OUTSIDE, "duration_s": 1.5})
    session = Session.whole(scenario, tmp_path, ends={})
    session.stranger(make_arm_program([], []), at_ns=A_SECOND + 200_250_000)
    session.clocks["s"].stall(2 * A_SECOND, A_SECOND // 100)
    log = session.run()
    skipped = log["s"].skipped
    assert skipped > 0
    assert log.absent_ticks("s") == skipped
    assert len(log["s"]) == 1500 - skipped

    facts = info(*log.sources).facts
    assert (facts["sites"]["m"]["skipped"], facts["sites"]["s"]["skipped"]) == (0, skipped)
    assert not any(channel["missing"] for channel in facts["channels"].values())
    for site in summarise_run(log)["sites"].values():
        assert site["missing"] == 0
    counts = {link.peer: link.counts for link in LinkSummary.list_of_log(log)}
    assert counts["s"] is not None
    assert counts["s"].sent == len(log["s"])
    assert counts["s"].missing == 0

    summary = session.relay.results["recorder"]
    assert isinstance(summary, list)
    (of_recorder,) = [line for line in summary if line.startswith("recorder: s:")]
    assert f", {skipped} skipped" in of_recorder
    assert "not executed" not in of_recorder
    phrase = "of them late by a period or more"
    assert any(f"{phrase}, {skipped} of them skipped" in line for line in session.said)
    assert any(
        f"{skipped} missing (lost, or ticks that s skipped)" in line for line in session.said
    )

    def delay(state: State) -> State:
        return msgspec.structs.replace(state, late_us=1000 if state.tick in (7, 9) else 1)

    late = rewrite_log(log, change=delay)
    page = render_report(late, None, CheckReport([]), summarise_run(late))
    assert "; 4 ticks began a period or more late and were executed nevertheless; " in page
    assert f"{skipped} ticks were skipped." in page


def test_arms_move_only_with_held_switches(tmp_path: Path) -> None:
    """Held from 0.2 s to 0.5 s, then silent; again from 0.8 s, and let go at 1.1 s."""
    session, ends = make_external_session(
        tmp_path, make_arm_program([], []), **{"sites.s.arm.dead_man": True, "duration_s": 1.5}
    )
    answers: list[tuple[bool, str]] = []

    def hold(bus: Bus, clock: RelayClock) -> None:
        with SwitchClient(bus, clock, SESSION, "s") as switch:
            while switch.record is None:
                sleep_for_ns(clock, PERIOD_NS)
            begun_ns = clock.monotonic_ns() - switch.record.t_ns
            for from_s, to_s in ((0.2, 0.5), (0.8, 1.1)):
                clock.sleep_until(begun_ns + round(from_s * 1e9))
                while clock.monotonic_ns() < begun_ns + round(to_s * 1e9):
                    switch.send(held=True)
                    sleep_for_ns(clock, 20_000_000)
            switch.send(held=False)
            sleep_for_ns(clock, 20_000_000)
            answers.extend(
                (answer.accepted, answer.text)
                for answer in reach_session(bus, clock).send_order(["s"], "enable")
            )

    session.stranger(hold, at_ns=A_SECOND)
    log = session.run()
    assert ends == {"m": 0, "s": 0}
    changes = [int(k) + 1 for k in np.flatnonzero(np.diff(log["s"].mode == "stopped"))]
    starts = np.array([0, *changes])
    assert log["s"].mode[0] == "stopped"
    # 480 ms and a silence of 100 ms
    assert np.abs(starts - [0, 200, 580, 800, 1100]).max() <= 5
    assert {log["s"].mode[k] for k in changes} == {"stopped", "return"}
    said = [
        re.search("STOPPED from .*: its dead-man switch is not held", event.text)
        for event in log.events
    ]
    assert len([text for text in said if text]) == 3
    assert answers == [
        (
            False,
            "the dead-man switch of s is not held; enable the site while the switch is held",
        )
    ]
    assert np.abs(np.diff(log["s"].tau, axis=0)).max() <= 2.0 * (1.0 + 1e-9)  # 2000 N m/s
    assert_reproduced(log)


def test_switches_need_external_arms() -> None:
    with pytest.raises(
        ScenarioError, match=r"sites\.s\.arm\.dead_man: applies only to an external arm"
    ):
        load_scenario("two_sites", {"sites.s.arm.dead_man": True})


class Switch:
    """A switch, and programs that report whether they hold the switch."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.dropped = Counter[str]()
        self.ring = StampingRing(self.clock.monotonic_ns, bytes, MEASUREMENTS_KEPT)
        self.switch = DeadManSwitch("s", self.ring, self.clock, self.dropped)

    def hear(
        self, boot: int, n: int, site: str = "s", *, held: bool = True, after_ns: int = 0
    ) -> bool:
        """Processes a message of one program; returns whether the switch is held then."""
        sleep_for_ns(self.clock, after_ns)
        self.ring.receive(encode(ArmEnable(site=site, boot=boot, n=n, held=held, sent_ns=0)))
        self.switch.poll()
        return self.switch.held


def stand(mode: Mode, reason: LifeReason) -> Site:
    """Returns a site that has changed to a mode for a reason."""
    site = Site(make_site_setup())
    site.arrays.site["mode"] = mode
    site.arrays.site["reason"] = reason
    return site


def test_switches_hold_until_released_or_silent() -> None:
    dead_man = Switch()
    switch = dead_man.switch
    clock = dead_man.clock
    ring = dead_man.ring
    hear = dead_man.hear
    assert switch.pop_order(stand(Mode.RUN, LifeReason.START)) == "released"
    assert switch.pop_order(stand(Mode.STOPPED, LifeReason.STOP)) == "released"
    assert switch.pop_order(stand(Mode.STOPPED, LifeReason.STOP_RELEASED)) == ""
    assert switch.pop_order(stand(Mode.FAULT, LifeReason.START)) == ""
    assert not hear(1, 0, site="m")
    assert hear(1, 5)
    assert switch.pop_order(stand(Mode.STOPPED, LifeReason.RELEASED)) == "held"
    assert (
        switch.pop_order(stand(Mode.STOPPED, LifeReason.STOP)) == ""
    )  # that ends by an order alone
    assert hear(2, 0, held=False)  # of one that does not hold it
    sleep_for_ns(clock, SWITCH_SILENCE_NS)
    assert switch.held
    assert not hear(1, 5, after_ns=1)  # said before
    assert switch.pop_order(stand(Mode.STOPPED, LifeReason.RELEASED)) == ""
    assert hear(1, 6)
    assert not hear(1, 7, held=False)
    assert hear(2, 1)
    ring.receive(b"garbage")
    switch.poll()
    assert dead_man.dropped == {"stranger": 1, "old switch message": 1, "malformed": 1}


@pytest.mark.parametrize("first", [1, 2])
def test_of_two_holders_either_release_stops(first: int) -> None:
    """The other one has to let go and press anew: a hand-over goes by way of a stop."""
    switch = Switch()
    other = 3 - first
    assert switch.hear(1, 0)
    assert switch.hear(2, 0)
    assert switch.switch.pop_order(stand(Mode.RUN, LifeReason.ALIGNED)) == ""
    assert not switch.hear(first, 1, held=False)
    assert not switch.hear(other, 1)  # it still holds
    assert switch.switch.pop_order(stand(Mode.RUN, LifeReason.ALIGNED)) == "released"
    assert not switch.hear(other, 2)
    assert not switch.hear(other, 3, held=False)
    assert switch.hear(other, 4)
    assert switch.switch.pop_order(stand(Mode.STOPPED, LifeReason.RELEASED)) == "held"


def test_of_two_holders_either_silence_stops() -> None:
    """Silence means that its program crashed; a release and press within a tick does not
    continue the hold either.
    """
    switch = Switch()
    assert switch.hear(1, 0)
    for n in range(4):
        assert switch.hear(2, n, after_ns=SWITCH_SILENCE_NS // 4)
    assert not switch.hear(2, 4, after_ns=1)
    assert switch.switch.pop_order(stand(Mode.RUN, LifeReason.ALIGNED)) == "released"
    assert not switch.hear(2, 5)
    assert not switch.hear(2, 6, held=False)
    assert switch.hear(2, 7)
    assert not switch.hear(2, 8, held=False)
    assert switch.hear(2, 9)
    assert switch.switch.pop_order(stand(Mode.RUN, LifeReason.ALIGNED)) == "released"
    assert switch.switch.pop_order(stand(Mode.STOPPED, LifeReason.RELEASED)) == "held"


def test_idle_switch_programs_displace_no_holder() -> None:
    switch = Switch()
    assert switch.hear(0, 0)
    for boot in range(1, 2 * STARTS_KEPT):
        assert switch.hear(boot, 0, held=False)
    assert not switch.hear(0, 0, after_ns=SWITCH_SILENCE_NS + 1)  # said before
    assert switch.dropped == {"old switch message": 1}


@pytest.mark.long
def test_killed_sites_return_with_their_arm(tmp_path: Path) -> None:
    """Both programs are started again by hand; meanwhile brakes hold the arm, and its peer holds."""
    glide = {"on_stale.action": "glide", "on_stale.align_limit_rad": 3.0}
    scenario = load_scenario(
        "two_sites", {**OUTSIDE, **glide, "duration_s": 6.0, "link.delay_ms": 50.0}
    )
    session = Session.whole(scenario, tmp_path, ends={})
    poses: list[tuple[int, list[float]]] = []
    drive = make_arm_program([], [], poses=poses)
    session.stranger(drive, at_ns=A_SECOND + 200_250_000)
    session.clocks["s"].dies_ns = 3 * A_SECOND
    session.stranger(drive, at_ns=4 * A_SECOND + 250_000)
    session.site("s", at_ns=4 * A_SECOND)
    log = session.run()
    assert [end for _, end in session.start_ends] == ["killed", 0, 0]
    ((first, _),) = log.starts["s"]
    (gone,) = log.absences["s"]
    before = [(now_ns, q) for now_ns, q in poses if now_ns < 4 * A_SECOND]
    assert before[-1][0] <= 3 * A_SECOND + FRESH_NS  # its program ends with the site
    part = log["s"]
    again = part.tick >= first
    assert part.q[again][0].tolist() == before[-1][1]
    assert part.mode[-1] == log["m"].mode[-1] == "run"
    assert set(log["m"].mode[gone[0] + 72 : first]) == {"hold"}
    assert np.abs(np.diff(part.tau[again], axis=0)).max() <= 2.0 * (1.0 + 1e-9)  # 2000 N m/s
    assert log.complete
    result = verify_log(log)
    assert (result.differing, result.unjudged, result.gaps) == (0, 0, [])
    assert result.absences == [("s", *gone)]


def test_without_an_arm_nothing_begins(tmp_path: Path) -> None:
    session = Session(load_scenario("two_sites", OUTSIDE), tmp_path / "run.mcap")

    def alone(clock: RelayClock) -> None:
        with pytest.raises(
            SessionError, match=r"s received no measurement from its arm on trilat/t/s/measured"
        ):
            session.live("s", clock)

    session.relay.add("s", alone)
    session.play()


def test_second_programs_and_garbage_change_nothing(tmp_path: Path) -> None:
    session, ends = make_external_session(tmp_path, make_arm_program([], []))

    def shout(bus: Bus, clock: RelayClock) -> None:
        other = ArmClient(bus, clock, SESSION, "s")
        publish = bus.publisher(topics.key(SESSION, "s", topics.MEASURED))
        for _ in range(50):
            other.send([9.0, 9.0], [0.0, 0.0])
            publish(b"garbage")
            sleep_for_ns(clock, 3_000_000)

    session.stranger(shout, at_ns=A_SECOND + 1_200_000_000)
    log = session.run()
    assert ends == {"m": 0, "s": 0}
    assert abs(log["s"].q).max() < 2.0
    dropped = log.link_stats("s")[-1].dropped
    assert (dropped["stranger"], dropped["malformed"]) == (50, 50)
    assert_reproduced(log)


def encode_measurement(**changed: object) -> bytes:
    fields = {
        "v": VERSION,
        "site": "s",
        "boot": 7,
        "n": 0,
        "q": [0.5, 0.25],
        "qd": [1.0, 2.0],
        "sent_ns": 5,
    }
    return msgpack.packb({**fields, **changed})


class Heard:
    def __init__(self) -> None:
        self.clock = ManualClock()
        self.ring = StampingRing(self.clock.monotonic_ns, bytes, MEASUREMENTS_KEPT)
        self.dropped: Counter[str] = Counter()
        site = Site(load_scenario("two_sites").setup("s"))
        self.arm = ExternalArm(site, self.ring, self.clock, self.dropped, "trilat/here/s/arm")

    def hear(self, *payloads: bytes) -> None:
        for payload in payloads:
            self.ring.receive(payload)
        self.arm.poll()


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "malformed"),
        (b"\xc1", "malformed"),
        (bytes(70_000), "oversized"),
        (encode_measurement(v=VERSION + 1), "version"),
        (encode_measurement(q=[1.0]), "of 1 joint; the scenario has 2"),
        (encode_measurement(qd=[1.0]), "malformed"),
        (encode_measurement(q=[1.0] * 13), "malformed"),
        (encode_measurement(q=[1.0, math.nan]), "not finite"),
        (encode_measurement(qd=[math.inf, 0.0]), "not finite"),
        (encode_measurement(tau_x=[1.0]), "malformed"),
        (encode_measurement(tau_x=[1.0, math.nan]), "malformed"),
        (encode_measurement(n=-1), "malformed"),
        (encode_measurement(more=1), "malformed"),
        (encode_measurement(site="m"), "stranger"),
    ],
)
def test_invalid_measurements_are_counted_and_dropped(payload: bytes, reason: str) -> None:
    heard = Heard()
    heard.hear(payload)
    assert heard.arm.newest is None
    assert heard.dropped == {reason: 1}


@given(order=st.permutations(range(8)), bound=st.booleans())
def test_the_newest_measurement_counts_in_any_order(order: list[int], bound: bool) -> None:
    heard = Heard()
    heard.hear(encode_measurement(n=0, q=[-0.001, 0.0]))
    if bound:
        heard.arm.bind((-0.001, 0.0))
    for n in order:
        heard.hear(encode_measurement(n=n + 1, q=[n / 1000, 0.0]))
        assert heard.arm.newest.q[0] == max(order[: order.index(n) + 1]) / 1000
    records = sum(n > max(order[:i], default=-1) for i, n in enumerate(order))
    assert heard.arm.accepted == 1 + records
    assert heard.dropped["old measurement"] == 8 - records


def test_a_flood_of_measurements_is_bounded_and_counted() -> None:
    heard = Heard()
    heard.hear(encode_measurement(n=0))
    heard.arm.bind((0.5, 0.25))
    heard.hear(encode_measurement(n=1), *(encode_measurement(n=n) for n in range(2, 502)))
    assert heard.arm.accepted == 1 + MEASUREMENTS_KEPT
    heard.hear(encode_measurement(n=510))
    assert heard.dropped["missing measurement"] == 8


def test_restarted_programs_count_until_the_session_begins() -> None:
    heard = Heard()
    heard.hear(encode_measurement(boot=1, n=900), encode_measurement(boot=2, n=0, q=[2.0, 2.0]))
    assert heard.arm.newest.q == [2.0, 2.0]
    heard.arm.bind((2.0, 2.0))
    heard.hear(encode_measurement(boot=3, n=0))
    assert heard.arm.newest.q == [2.0, 2.0]
    assert heard.dropped == {"stranger": 1}


def test_silence_counts_only_hearing_time() -> None:
    """A process that slept for a minute has heard nothing, and knows nothing of the arm."""
    heard = Heard()
    heard.hear(encode_measurement())
    heard.arm.bind((0.5, 0.25))
    heard.clock.sleep_until(60 * A_SECOND)
    heard.hear()
    orders = [heard.arm.pop_order(Mode.RUN)]
    for _ in range(SILENCE_LIMIT_NS // PERIOD_NS + 1):
        sleep_for_ns(heard.clock, PERIOD_NS)
        heard.hear()
        orders.append(heard.arm.pop_order(Mode.HOLD if "arm_silent" in orders else Mode.RUN))
    # the sleep counts as 20 ms: no longer is it known that nothing came
    assert orders.index("arm_silent") == (HELD_SILENCE_NS - 20_000_000) // PERIOD_NS + 1
    assert orders.index("arm_lost") == (SILENCE_LIMIT_NS - 20_000_000) // PERIOD_NS + 1
    assert heard.arm.pop_order(Mode.FAULT) == ""
    assert heard.arm.pop_order(Mode.WAITING) == "arm_lost"  # reset too early
    heard.hear(encode_measurement(boot=9, n=0))  # its program was started anew
    assert heard.arm.pop_order(Mode.FAULT) == ""
    assert heard.arm.newest.q == [0.5, 0.25]


def test_short_silences_end_with_a_measurement() -> None:
    heard = Heard()
    heard.hear(encode_measurement())
    heard.arm.bind((0.5, 0.25))
    for _ in range(40):
        sleep_for_ns(heard.clock, PERIOD_NS)
        heard.hear()
    assert heard.arm.pop_order(Mode.RUN) == "arm_silent"
    heard.hear(encode_measurement(boot=9, n=1))
    assert heard.arm.pop_order(Mode.HOLD) == ""
    heard.hear(encode_measurement(n=1))
    assert heard.arm.pop_order(Mode.HOLD) == "arm_back"
    assert heard.arm.pop_order(Mode.RETURN) == ""


def test_encoder_glitches_count_as_silence() -> None:
    """The arm of two_sites may move at 100 rad/s, 0.1 rad in a period."""
    heard = Heard()
    heard.hear(encode_measurement(n=0))
    heard.arm.bind((0.5, 0.25))
    for n in range(1, 6):
        sleep_for_ns(heard.clock, PERIOD_NS)
        heard.hear(encode_measurement(n=n, q=[1.5, 0.25] if n == 3 else [0.5, 0.25]))
        assert heard.arm.newest.q == [0.5, 0.25]
    assert heard.dropped["implausible measurement"] == 1
    for n in range(6, 80):
        sleep_for_ns(heard.clock, PERIOD_NS // 10)
        heard.hear(encode_measurement(n=n, q=[40.0, 0.25]))
    assert heard.arm.newest.q == [0.5, 0.25]
    assert heard.dropped["implausible measurement"] == 75


def test_torque_counts_while_fresh_and_running() -> None:
    network = LocalNetwork()
    clock = ManualClock()
    site = network.join()
    port = ArmClient(network.join(), clock, "t", "s")
    assert port.torque() is None
    zeros = dict.fromkeys(("tick", "t_ns", "rx_crc", "late_us", "busy_us"), 0)
    vectors = {key: [0.0, 0.0] for key in ("q", "qd", "q_des", "qd_des", "tau_x")}

    def at(tick: int, **changed: object) -> bytes:
        return msgpack.packb({**state, "tick": tick, "t_ns": tick * PERIOD_NS, **changed})

    state = {
        "v": VERSION,
        "site": "s",
        "boot": 5,
        "mode": "run",
        **zeros,
        **vectors,
        "tau": [1.5, -2.5],
    }
    state |= {"theta_hat": [0.0] * 5, "used": {}, "rx": [], "cmd": [], "mem": []}
    say = site.publisher("trilat/t/s/state")
    say(msgpack.packb(state))
    assert port.torque() == (1.5, -2.5)
    say(msgpack.packb({**state, "boot": 6, "tau": [9.0, 9.0]}))  # a stranger's
    say(b"garbage")
    assert port.torque() == (1.5, -2.5)
    clock.sleep_until(FRESH_NS + 1)
    assert port.torque() is None
    say(at(1))
    assert port.torque() == (1.5, -2.5)
    for replayed in (at(1, tau=[9.0, 9.0]), at(0, tau=[9.0, 9.0]), at(1200, tau=[9.0, 9.0])):
        say(replayed)
        assert port.torque() == (1.5, -2.5)
    say(at(2, mode="fault", mem=[0.0, 0.0, 1e6, 0.0, 0.0, 6.0]))
    assert port.torque() == (1.5, -2.5)  # it comes down to damping and gravity
    say(at(102, mode="fault", mem=[0.0, 0.0, 1e6, 0.0, 0.0, 6.0]))
    assert port.torque() is None
    say(at(103))
    assert port.torque() == (1.5, -2.5)
    for tick, reason, torque in (
        (110, LifeReason.RELEASED, None),
        (120, LifeReason.STOP, (1.5, -2.5)),
        (121, LifeReason.STOP_RELEASED, None),
    ):
        say(at(tick, mode="stopped", mem=[0.0, 0.0, 1e6, 0.0, 0.0, float(reason)]))
        assert port.torque() == torque
    say(at(125, mode="fault", mem=[]))  # since when, it does not say
    assert port.torque() is None
    say(at(130, mode="diverged"))
    assert port.torque() is None
    assert not port.over
    site.publisher("trilat/t/s/event")(
        encode(Event(member="s", boot=5, kind="end", text="made 3 ticks"))
    )
    assert port.over


def test_a_missing_site_is_over() -> None:
    network = LocalNetwork()
    port = ArmClient(network.join(), ManualClock(), "t", "s")
    site = network.join()
    assert not port.over
    site.announce("trilat/t/s/alive/5")
    assert not port.over
    site.close()
    assert port.over


def test_the_example_of_a_message_is_one() -> None:
    message = ArmMeasurement(site="s", boot=7, n=0, q=[0.5, 0.25], qd=[1.0, 2.0], sent_ns=5)
    assert encode(message) == encode_measurement(tau_x=[])


def test_the_page_names_every_field_of_a_message() -> None:
    docs = Path(__file__).parents[2] / "docs"
    how_to = (docs / "sessions" / "external-arm.md").read_text(encoding="utf-8")
    page = (docs / "develop" / "session-protocol.md").read_text(encoding="utf-8")
    table = page[page.index("| `v` |") : page.index("The torque stands")]
    assert set(re.findall(r"`(\w+)`", table)) == set(ArmMeasurement.__struct_fields__)
    assert f"| {VERSION}, the version of the messages |" in table
    assert "`v`, `site`, `boot`, `n` and `sent_ns` as above and `held`" in " ".join(
        page.split()
    )
    assert set(ArmEnable.__struct_fields__) - set(ArmMeasurement.__struct_fields__) == {"held"}
    for seconds in (HELD_SILENCE_NS, SILENCE_LIMIT_NS, FRESH_NS, SWITCH_SILENCE_NS):
        assert f"{seconds * 1e-9:g} s" in how_to
    assert f"at most {MEASUREMENTS_KEPT} wait" in how_to
