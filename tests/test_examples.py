"""Examples run unchanged, with and without their optional equipment."""

import itertools
import math
import os
import random
import re
import runpy
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

import trilat_net
from tests.log.builders import make_log_bytes, write_log
from tests.net.waiting import sleep_for_ns, until
from tests.sites.devices import CapReports, HaplyService
from tests.sites.relay import RelayClock
from tests.sites.sessions import Session, reach_session
from trilat_net.log.ros2.topic_names import TopicTable
from trilat_net.net.arm_client import SwitchClient
from trilat_net.net.bus import Bus
from trilat_net.scenario import load_scenario

LOOK = Path(__file__).parents[1] / "examples" / "look_into_a_log.py"


@pytest.fixture(autouse=True)
def quiet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")


@pytest.mark.parametrize("polars", [True, False])
def test_a_look_into_a_log(
    polars: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if not polars:
        monkeypatch.setitem(sys.modules, "polars", None)
    write_log(tmp_path, make_log_bytes("paper"))
    monkeypatch.setattr(sys, "argv", [str(LOOK), "run.mcap"] if polars else [str(LOOK)])
    runpy.run_path(str(LOOK), run_name="__main__")
    plt.close("all")
    printed = capsys.readouterr().out
    assert (
        "virtual session paper of m1, m2, s" in printed or "virtual session jitter" in printed
    )
    assert ("no polars" in printed) is not polars
    assert (tmp_path / "look_into_a_log.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_springs_with_reactions_have_zero_sum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Forces of springs that act at both ends move no centre: by d qd_i summed, the mean pose stays."""
    monkeypatch.syspath_prepend(LOOK.parent)
    law = {"control.law": "reaction_law:Reaction", "link.delay_ms": 5.0, "duration_s": 6.0}
    log = trilat_net.simulate("free", {**law, "scheme": "digital"})
    poses = np.array([log[name].q[-1] for name in log.sites])
    started = np.mean([log[name].q[0] for name in log.sites], axis=0)
    np.testing.assert_allclose(poses, np.broadcast_to(poses[0], poses.shape), atol=2e-3)
    pulls = [log[name].states[-1].ch for name in log.sites]
    assert np.abs(pulls).max() < 0.05
    np.testing.assert_allclose(poses.mean(axis=0), started, atol=0.05)
    assert trilat_net.verify(log).passed


class PinnedArm:
    """Stands in for a hand of a session whose arm stays still: a spring of 300 N/m at one place."""

    def __init__(self, rounds: float = math.inf) -> None:
        self.target = (1.0, 0.5)
        self.moves = 0
        self.released = 0
        self.rounds = rounds
        self.pose = self.target

    @property
    def over(self) -> bool:
        self.rounds -= 1
        return self.rounds < 0

    @property
    def force(self) -> tuple[float, ...]:
        return tuple(300.0 * (a - b) for a, b in zip(self.target, self.pose, strict=True))

    def move(self, *target: float) -> None:
        self.target = target
        self.moves = self.moves + 1

    def release(self) -> None:
        self.released += 1


def run_with_hand(
    name: str, arm: PinnedArm, monkeypatch: pytest.MonkeyPatch, *options: str
) -> None:
    """Runs an example whose hand holds such an arm, and which does not wait."""
    monkeypatch.setattr(trilat_net, "hand", lambda *_, **__: nullcontext(arm), raising=False)
    monkeypatch.setattr(sys, "argv", [name, "play", "m1", *options])
    monkeypatch.setattr("time.sleep", lambda _: None)
    runpy.run_path(str(LOOK.with_name(name)), run_name="__main__")


def test_a_device_rests_where_hand_and_user_balance(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """6 N at 300 N/m are 20 mm."""
    arm = PinnedArm(rounds=3000)
    run_with_hand("haptic_device.py", arm, monkeypatch, "--seconds", "1000")
    assert "(0.0, 20.0) mm" in capsys.readouterr().out
    assert arm.force == pytest.approx((0.0, 6.0), abs=1e-3)
    assert arm.moves == 3000


def device_of(name: str, monkeypatch: pytest.MonkeyPatch, *options: str) -> Any:
    """Returns the device with which an example leads m1 of `play`."""
    devices: dict[str, Any] = {}
    session = SimpleNamespace(lead=lambda site, device: devices.update({site: device}))
    monkeypatch.setattr(
        trilat_net, "session", lambda name, connect: {("play", None): session}[name, connect]
    )
    monkeypatch.setattr(sys, "argv", [name, "play", "m1", *options])
    runpy.run_path(str(LOOK.with_name(name)), run_name="__main__")
    return devices["m1"]


def test_force_of_the_haply_example_is_smooth(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of 1 N is a sixth of it at once, and whole after 50 ms."""
    with (
        HaplyService() as service,
        device_of("haply_hand.py", monkeypatch, "--address", service.address) as device,
    ):
        for _ in range(50):
            device.read()
            device.render((0.0, 0.0, 1.0))
        until(lambda: len(service.asked) == 50)
        up = [force[2] for force in service.forces]
    assert up[0] == pytest.approx(1.0 / 6.0)
    assert max(np.diff(up)) < 0.2
    assert up[-1] == pytest.approx(1.0, abs=1e-3)


def test_spacemouse_example_moves_along_one_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    cap = CapReports()
    with device_of("spacemouse_hand.py", monkeypatch, "--device", cap.path) as device:
        for _ in range(20):
            cap.push(100, -300, 20)
            state = device.read()
        assert state.position_m[1] > 0.0
        assert (state.position_m[0], state.position_m[2]) == (0.0, 0.0)


def test_the_headset_scenario_is_stable() -> None:
    log = trilat_net.simulate(LOOK.with_name("headset.toml"), duration_s=0.5)
    assert log.scenario.open_hands == ("m1", "m2")


@pytest.mark.parametrize("name", ["two_operators", "two_operators_six_joints"])
def test_two_operator_scenarios_run_with_simulated_robots(name: str) -> None:
    path = LOOK.with_name(f"{name}.toml")
    live = trilat_net.load_scenario(path)
    assert live.outside == ("s",)
    assert {spec.on_stale.action for spec in live.sites.values()} == {"glide"}
    settings = {**live.simulated_settings, "link.model": "none"}
    log = trilat_net.simulate(path, settings, duration_s=2.0)
    assert log.scenario.open_hands == ("m1", "m2")
    assert abs(log["s"].q - log["s"].q[0]).max() < 1e-9  # no arm sinks


def test_six_joint_robot_follows_a_push() -> None:
    path = LOOK.with_name("two_operators_six_joints.toml")
    push = {"kind": "pulse", "start_s": 1.0, "end_s": 4.0, "peak_nm": [10, 10, 10, 3, 2, 1]}
    settings = trilat_net.load_scenario(path).simulated_settings
    log = trilat_net.simulate(path, {**settings, "sites.m1.hands": [push]}, duration_s=20.0)
    moved = abs(log["s"].q[-1] - log["s"].q[0])
    assert min(moved) > 0.2, "each joint was pushed"
    assert abs(log["s"].q[-1] - log["m1"].q[-1]).max() < 0.01
    assert {"stopped", "fault"}.isdisjoint(log["s"].mode)


@pytest.mark.parametrize(
    ("example", "file"),
    [
        ("two_operators_six_joints.toml", "robot_six_joints.toml"),
        ("two_operators.toml", "robot_two_joints.toml"),
        ("external_arm.toml", "robot_two_joints.toml"),
    ],
)
def test_robot_file_fits_its_scenario(example: str, file: str) -> None:
    scenario = trilat_net.load_scenario(LOOK.with_name(example))
    table = TopicTable.read(str(LOOK.with_name(file)))
    robot = table.robots["s"]
    table.refuse_other_robots(scenario)
    joints = len(scenario.sites["s"].q0_rad)
    assert len(robot.joints) == len(robot.safe) == joints
    assert sorted(robot.controller) == sorted(robot.joints)
    assert table.find(scenario.name, "s", "robot_states") == "joint_states"
    assert table.find(scenario.name, "s", "robot_commands") == "effort_controller/commands"


def test_a_gamepad_names_its_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "evdev", None)
    with pytest.raises(SystemExit, match="pip install evdev"):
        run_with_hand("gamepad_hand.py", PinnedArm(), monkeypatch)


def test_sticks_move_targets_and_buttons_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stick held to the right for a second moves the target by 0.3 m; a released stick leaves
    the target there.
    """
    codes = SimpleNamespace(EV_ABS=3, EV_KEY=1, ABS_X=0, ABS_Y=1, BTN_SOUTH=304)
    at_rest = SimpleNamespace(min=0, max=255)
    rounds = itertools.count()
    script = {0: (3, 0, 255), 60: (3, 0, 128), 80: (1, 304, 1)}

    def read_one() -> SimpleNamespace | None:
        event = script.pop(next(rounds), None)
        return event and SimpleNamespace(
            **dict(zip(("type", "code", "value"), event, strict=True))
        )

    pad = SimpleNamespace(
        capabilities=lambda: {3: [(0, at_rest), (1, at_rest)]}, read_one=read_one
    )
    evdev = SimpleNamespace(ecodes=codes, list_devices=lambda: ["a"], InputDevice=lambda _: pad)
    monkeypatch.setitem(sys.modules, "evdev", evdev)
    arm = PinnedArm(rounds=120)
    run_with_hand("gamepad_hand.py", arm, monkeypatch)
    assert arm.target == pytest.approx((1.3, 0.5), abs=0.012)
    assert arm.released > 0


class PressedSwitch:
    """Stands in for the switch of an arm, whose session ends after some rounds."""

    def __init__(self, rounds: int) -> None:
        self.said: list[bool] = []
        self.rounds = rounds

    @property
    def over(self) -> bool:
        return len(self.said) >= self.rounds

    def send(self, *, held: bool) -> None:
        self.said.append(held)


def test_a_switch_is_held_by_keys_until_gaps() -> None:
    """Rounds of 20 ms: a key in the 5th, another in the 30th; each counts for 0.6 s."""
    hold = runpy.run_path(str(LOOK.with_name("dead_man_switch.py")))["hold"]
    switch = PressedSwitch(100)
    keys = (b"x" if n in (5, 30) else b"" for n in itertools.count())
    hold(switch, lambda: next(keys), lambda: len(switch.said) * 0.02, 0.599)
    assert switch.said == [5 <= n < 60 for n in range(101)]


def test_ending_programs_release_their_switch(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = os.pipe()
    os.write(ends[1], b"pressed\n")
    os.close(ends[1])
    switch = PressedSwitch(1000)
    monkeypatch.setattr(SwitchClient, "connected", lambda *_, **__: nullcontext(switch))
    monkeypatch.setattr(
        sys, "argv", ["dead_man_switch.py", "play", "s", "--connect", "tcp/127.0.0.1:1"]
    )
    with os.fdopen(ends[0]) as reader:
        monkeypatch.setattr(sys, "stdin", reader)
        runpy.run_path(str(LOOK.with_name("dead_man_switch.py")), run_name="__main__")
    assert switch.said == [True, False]


@pytest.mark.long
def test_programs_hand_over_without_a_step(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The example in a session without a late tick: no reference steps further while the lead changes."""
    example = runpy.run_path(str(LOOK.with_name("policy_hand.py")))
    scenario = load_scenario("play", {"duration_s": 11.0})
    session = Session.whole(scenario, tmp_path)

    def act(bus: Bus, clock: RelayClock) -> None:
        def wait_s(time_s: float) -> None:
            sleep_for_ns(clock, round(time_s * 1e9))

        running = reach_session(bus, clock)
        wait_s(1.0)
        with (
            running.open_hand(bus, "m2", scenario) as program,
            running.open_hand(bus, "m1", scenario) as person,
        ):
            moved = example["lead"](
                running, program, person, 9.0, lambda: 1e-9 * clock.monotonic_ns(), wait_s
            )
        example["report"](*moved)

    session.stranger(act)
    assert trilat_net.verify(session.run()).passed
    times = re.findall(r"([.\d]+) times", capsys.readouterr().out)
    assert len(times) == 3
    assert max(map(float, times)) <= 1.2


def test_recorded_episodes_are_marked_with_their_outcome(tmp_path: Path) -> None:
    """One episode has time to arrive, the next one ends while the arm still moves."""
    example = runpy.run_path(str(LOOK.with_name("record_episodes.py")))
    scenario = load_scenario("play", {"duration_s": 6.5, "link.delay_ms": 0.0})
    session = Session.whole(scenario, tmp_path)
    outcomes: list[bool] = []

    def act(bus: Bus, clock: RelayClock) -> None:
        def wait_s(time_s: float) -> None:
            sleep_for_ns(clock, round(time_s * 1e9))

        with (
            reach_session(bus, clock) as running,
            running.open_hand(bus, "m1", scenario) as hand,
            running.open_hand(bus, "m2", scenario) as follower,
        ):
            for seconds in (4.0, 0.04):
                outcomes.extend(
                    example["record"](
                        running,
                        hand,
                        follower,
                        leads=True,
                        episodes=1,
                        seconds=seconds,
                        draw=random.Random(1),
                        now_s=lambda: 1e-9 * clock.monotonic_ns(),
                        wait_s=wait_s,
                    )
                )

    session.stranger(act)
    log = session.run()
    marks = [event.text for event in log.events if event.kind == "mark"]
    assert outcomes == [True, False]
    assert [text.removeprefix("episode reach 1 ") for text in marks] == [
        "begins",
        "succeeded",
        "begins",
        "failed",
    ]
    # Someone holds m2 in the episodes, so that the forces of its operator are not all zero.
    assert np.abs(log["m2"].tau_x).max() > 0.0


def test_people_take_over_from_failing_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a ramp the slave reaches its goal, with smaller steps of the reference than by a jump."""
    monkeypatch.syspath_prepend(LOOK.parent)
    takeover = runpy.run_path(str(LOOK.with_name("takeover.py")))
    weights = np.array([0.95, -0.3, 0.3, 0.5])
    left, abrupt, blended = (
        takeover["run"](weights, 3, ramp_s) for ramp_s in takeover["WAYS"].values()
    )
    assert blended["success"] == 1.0 > left["success"]
    assert blended["jump"] < abrupt["jump"]
    assert blended["without_control_s"] == 0.0


def test_a_trained_policy_acts_alike_as_a_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The class as a hand of the scenario repeats an episode's actions, bit for bit."""
    monkeypatch.syspath_prepend(LOOK.parent)
    study = runpy.run_path(str(LOOK.with_name("train_over_delay.py")))
    env = study["make_env"](study["STUDIES"]["reach"], "200 ms, bursts")
    weights = [0.95, 0.02, -0.11, 0.71]
    assert 0.0 < study["play"](env, np.array(weights), 3) < 0.2
    trained = trilat_net.open_log(env.save(tmp_path / "episode.mcap"))
    hand = {"kind": "own", "class": "reach_policy:ReachPolicy", "rate_hz": 25, **study["FIRM"]}
    hand |= {
        "force_limit_n": 200.0,
        "acceleration_limit_m_s2": 20.0,  # that of the environment, whose user is a live hand
        "settings": {"goal_m": env.task.goal.tolist(), "weights": weights},
    }
    acted = trilat_net.simulate(
        env.scenario, {"sites.m2.hands": [hand]}, duration_s=trained["m2"].t_s[-1]
    )
    for name in trained.sites:
        count = len(acted[name])
        assert np.array_equal(acted[name].q, trained[name].q[:count]), name


@pytest.mark.parametrize("task", ["reach", "box"])
def test_a_study_of_training_reports_intervals(
    task: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.syspath_prepend(LOOK.parent)
    study = runpy.run_path(str(LOOK.with_name("train_over_delay.py")))
    short = study["STUDIES"][task]._replace(rounds=1, pairs=1)
    study["STUDIES"][task] = short
    study["run_seed"].__globals__.update(STUDIES=study["STUDIES"], TESTS=1, EPISODE_S=0.4)
    rates = [study["run_seed"](task, seed) for seed in (1, 2)]
    assert rates[0]["weights"] != rates[1]["weights"]
    spans = study["report"](rates, short.measure)
    assert all(low <= mean <= high for mean, low, high in spans.values())
    study["draw"](rates, short.measure, tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").read_bytes().startswith(b"\x89PNG")
    assert "2 seeds, 95 % interval" in capsys.readouterr().out
