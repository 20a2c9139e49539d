"""A policy and a person in one session, through the interfaces of LeRobot."""

import json
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest

import trilat_net
from tests.sites.relay import RelayClock
from tests.sites.sessions import Session, reach_session
from trilat_net.errors import UsageError
from trilat_net.log.log_reader import Log
from trilat_net.net.bus import Bus
from trilat_net.scenario import load_scenario

from .driving import ROBOT, TELEOPERATOR, assert_taken_over, drive
from .lerobot_stub import PLUGINS, make_device, plugins


@pytest.fixture
def found_plugins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[dict[str, ModuleType]]:
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    with plugins() as modules:
        yield modules


def test_lerobot_finds_a_plugin_by_its_distribution_name(
    found_plugins: dict[str, ModuleType],
) -> None:
    """LeRobot imports the module of that name, and the module registers its configuration."""
    assert sorted(found_plugins) == [ROBOT, TELEOPERATOR]
    for folder, (name, module) in zip(PLUGINS, found_plugins.items(), strict=True):
        project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))
        assert project["project"]["name"] == module.__name__ == name
        assert project["tool"]["setuptools"]["py-modules"] == [name]
    assert found_plugins[ROBOT].TrilatRobotConfig().type == "trilat"
    assert found_plugins[TELEOPERATOR].TrilatTeleoperatorConfig().type == "trilat"


def test_plugins_import_the_interface_alone() -> None:
    """The one import of each plugin from this program is that of its interface."""
    for folder in PLUGINS:
        lines = (folder / f"{folder.name}.py").read_text(encoding="utf-8").splitlines()
        imports = [line for line in lines if re.match(r"(import|from) .*trilat_net", line)]
        assert imports == ["import trilat_net as tn"]


def test_features_follow_from_the_scenario_before_any_connection(
    found_plugins: dict[str, ModuleType],
) -> None:
    robot = make_device(found_plugins[ROBOT].TrilatRobotConfig())
    joints = [
        f"{site}.{q}.{what}"
        for site in ("s", "m2")
        for what in ("pos", "vel", "tau_x")
        for q in ("q1", "q2")
    ]
    assert list(robot.observation_features) == [*joints, "x.pos", "y.pos", "x.felt", "y.felt"]
    assert robot.action_features == {"x.pos": float, "y.pos": float}
    teleoperator = make_device(found_plugins[TELEOPERATOR].TrilatTeleoperatorConfig())
    assert (
        teleoperator.action_features == teleoperator.feedback_features == robot.action_features
    )
    assert not robot.is_connected
    with pytest.raises(ConnectionError, match="not connected"):
        robot.get_observation()


def test_robot_has_no_cameras_and_ends_with_session(
    found_plugins: dict[str, ModuleType],
) -> None:
    """`lerobot-record` counts the cameras and disconnects only connected devices."""
    robot = make_device(found_plugins[ROBOT].TrilatRobotConfig())
    assert robot.cameras == {}
    closed: list[str] = []
    robot._stack.callback(closed.append, "closed")
    robot._hand = SimpleNamespace(over=True)
    for call in (
        robot.get_observation,
        lambda: robot.send_action({"x.pos": 0.9, "y.pos": 1.1}),
    ):
        with pytest.raises(ConnectionError, match="the session play has ended"):
            call()
    assert robot.is_connected
    robot.disconnect()
    assert closed == ["closed"]
    assert not robot.is_connected


def test_an_arm_named_twice_is_observed_once(
    found_plugins: dict[str, ModuleType],
) -> None:
    robot = make_device(found_plugins[ROBOT].TrilatRobotConfig(slave="m2"))
    robot._hand = SimpleNamespace(over=False, pose=[7.0, 8.0], force=[9.0, 10.0])
    robot._records["m2"] = SimpleNamespace(q=[1.0, 2.0], qd=[3.0, 4.0], tau_x=[5.0, 6.0])
    robot._receive_records = list
    observed = robot.get_observation()
    assert list(observed) == list(robot.observation_features)
    assert [*observed.values()] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, -9.0, -10.0]


SPACE = Path(__file__).parents[4] / "tests" / "presentation" / "cases" / "tool_down.toml"


@pytest.mark.parametrize(("actions", "mode"), [("tip", "tip"), ("joints", "joint")])
@pytest.mark.parametrize("space", [False, True])
def test_a_dataset_has_the_actions_the_plugin_accepts(
    found_plugins: dict[str, ModuleType], tmp_path: Path, actions: str, mode: str, space: bool
) -> None:
    """Names and order are the plugin's features; the numbers are the position of the user's hand."""
    site, slave = ("m", "s") if space else ("m2", "s")
    hands = {f"sites.{site}.hands": [{"kind": "live", "mode": mode}], "duration_s": 0.1}
    scenario = load_scenario(str(SPACE) if space else "play", hands)
    (tmp_path / "held.toml").write_text(scenario.text, encoding="utf-8")
    config = found_plugins[ROBOT].TrilatRobotConfig(
        scenario=str(tmp_path / "held.toml"), site=site, slave=slave
    )
    features = make_device(config).action_features
    log = trilat_net.simulate(scenario)
    trilat_net.export(log, "lerobot", tmp_path / "set", actions=actions, fps=100)
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text(encoding="utf-8"))
    origin = json.loads((tmp_path / "set" / "about.json").read_text(encoding="utf-8"))
    assert info["features"]["action"]["names"] == list(features)
    assert info["features"][f"action.{site}"]["shape"] == [len(features)]
    assert origin["actions"] == actions
    frames = pl.read_parquet(tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet")
    q = log[site].q[:: log[site].rate_hz // 100].tolist()
    hand_goal = scenario.arms[site].end_effector if actions == "tip" else tuple
    wanted = np.array([hand_goal(row) for row in q], dtype=np.float32)
    assert frames[f"action.{site}"].to_numpy() == pytest.approx(wanted[: len(frames)], abs=1e-6)


@pytest.mark.parametrize("mode", ["tip", "joint", "force"])
@pytest.mark.parametrize("space", [False, True])
def test_a_dataset_has_the_observations_of_the_plugin(
    found_plugins: dict[str, ModuleType], tmp_path: Path, mode: str, space: bool
) -> None:
    site = "m" if space else "m2"
    hands = {f"sites.{site}.hands": [{"kind": "live", "mode": mode}], "duration_s": 0.1}
    scenario = load_scenario(str(SPACE) if space else "play", hands)
    (tmp_path / "held.toml").write_text(scenario.text, encoding="utf-8")
    config = found_plugins[ROBOT].TrilatRobotConfig(
        scenario=str(tmp_path / "held.toml"), site=site
    )
    robot = make_device(config)
    settings = {"actions": "tip"} if mode == "force" else {}
    log = trilat_net.simulate(scenario)
    if mode == "force":
        with pytest.raises(UsageError, match="commanded by forces"):
            trilat_net.export(log, "lerobot", tmp_path / "none", observations="plugin")
    trilat_net.export(log, "lerobot", tmp_path / "set", observations="plugin", **settings)
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text(encoding="utf-8"))
    state = info["features"]["observation.state"]
    assert state["names"] == list(robot.observation_features)
    assert state["shape"] == [len(robot.observation_features)]
    if mode != "force":
        assert info["features"]["action"]["names"] == list(robot.action_features)


def test_a_policy_gets_both_states_at_its_rate(
    found_plugins: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy gets the numbers in the order of the features, and its actions get their names."""
    now_s = 0.0
    actions: list[Any] = []
    request_times_s: list[float] = []

    def sleep(time_s: float) -> None:
        nonlocal now_s
        now_s += time_s

    def decide(state: dict[str, list[float]]) -> list[float]:
        nonlocal now_s
        request_times_s.append(now_s)
        now_s += 0.01
        assert list(state) == ["observation.state", "observation.environment_state"]
        assert list(state.values()) == 2 * [[1.0, 2.0]]
        return [3.0, 4.0]

    clock = SimpleNamespace(sleep=sleep, monotonic=lambda: now_s)
    monkeypatch.setattr(found_plugins[ROBOT], "time", clock)
    robot = SimpleNamespace(
        get_observation=lambda: {"b": 2, "a": 1},
        observation_features={"a": float, "b": float},
        action_features={"x.pos": float, "y.pos": float},
        send_action=actions.append,
    )
    assert found_plugins[ROBOT].run_policy(robot, decide, 0.5, 10) == 5
    assert request_times_s == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert actions == 5 * [{"x.pos": 3.0, "y.pos": 4.0}]


@pytest.mark.parametrize("config", ["TrilatRobotConfig", "TrilatTeleoperatorConfig"])
def test_an_arm_that_nobody_can_hold_is_refused(
    config: str, found_plugins: dict[str, ModuleType]
) -> None:
    module = found_plugins[ROBOT if "Robot" in config else TELEOPERATOR]
    with pytest.raises(ValueError, match="no operator of kind 'live' at m1"):
        make_device(getattr(module, config)(session="paper", site="m1"))


def test_a_person_takes_over_from_a_policy(
    found_plugins: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = load_scenario("play", {"duration_s": 4.0, "rate_hz": 200})
    session = Session.whole(scenario, tmp_path)
    seen: dict[str, Any] = {}

    def act(bus: Bus, clock: RelayClock) -> None:
        def wait_s(time_s: float) -> None:
            clock.sleep_until(clock.monotonic_ns() + round(time_s * 1e9))

        @contextmanager
        def hold(_name: str, site: str, source: str, **_: Any) -> Iterator[Any]:
            with reach_session(bus, clock).open_hand(bus, site, scenario, source) as hand:
                yield hand

        monkeypatch.setattr(trilat_net, "hand", hold, raising=False)
        monkeypatch.setattr(
            trilat_net, "session", lambda *_, **__: reach_session(bus, clock), raising=False
        )
        relayed = SimpleNamespace(sleep=wait_s, monotonic=lambda: 1e-9 * clock.monotonic_ns())
        monkeypatch.setattr(found_plugins[ROBOT], "time", relayed)
        wait_s(1.0)
        seen.update(drive(found_plugins, reach_session(bus, clock), wait_s))

    session.stranger(act)
    log = session.run()
    assert trilat_net.verify(log).passed
    assert_taken_over(seen, log)
    assert_observed(seen["observed"], log, tmp_path / "set")


def assert_observed(observed: dict[str, float], log: Log, folder: Path) -> None:
    """Asserts that a frame of the dataset has each arm's observation, with the policy as its program."""
    trilat_net.export(log, "lerobot", folder, observations="plugin", fps=200)
    frames = pl.read_parquet(folder / "data" / "chunk-000" / "file-000.parquet")
    state = frames["observation.state"].to_numpy()
    seen = np.array(list(observed.values()), dtype=np.float32)
    slave = [name.startswith("s.") for name in observed]
    for part in (np.array(slave), ~np.array(slave)):
        distance = np.abs(state[:, part] - seen[part]).max(axis=1)
        assert distance.min() < 1e-5
    origin = json.loads((folder / "about.json").read_text(encoding="utf-8"))
    assert origin["program"] == origin["sessions"][0]["plugin_site"] == "m2"
    assert frames["intervention"].any()
    assert not frames["intervention"].all()
