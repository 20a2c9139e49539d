"""Users' own hands and plants in virtual time: their effect is recorded, and a log repeats that
effect without their code.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import trilat_net as tn
from tests.own_code import Follower
from trilat_net.core.life.own_hand import HandView
from trilat_net.core.step.site_step import Site
from trilat_net.errors import CodeWithheld, PlantFailed, ScenarioError
from trilat_net.execution.fused import FusedRun
from trilat_net.execution.virtual import SimulatedLog, record_virtual
from trilat_net.log.log_reader import Log
from trilat_net.own_code.imported_code import allowed_code
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.operators.program_hand import HandPlayer, HandSite

SIGNALS = ("q", "qd", "tau", "q_des", "tau_x", "theta_hat")


def at_m2(kind: str = "Circle", **keys: Any) -> dict[str, Any]:
    hand = {"kind": "own", "class": f"tests.own_code:{kind}", **keys}
    return {"sites.m2.hands": [hand], "duration_s": 1.5}


def with_plant(kind: str = "Arm", **keys: Any) -> dict[str, Any]:
    return {"sites.s.plant": {"class": f"tests.own_code:{kind}", **keys}, "duration_s": 1.5}


@pytest.fixture
def kept_consents() -> Iterator[None]:
    kept = dict(allowed_code)
    allowed_code.clear()
    yield
    allowed_code.update(kept)


def without_code(log: SimulatedLog) -> Log:
    """Returns the log as opened by a stranger, who permits no code."""
    allowed_code.clear()
    return log


@pytest.mark.parametrize("kind", ["Circle", "Follower"])
@pytest.mark.parametrize(
    "keys", [{}, {"rate_hz": 100, "delay_ms": 0.0}, {"mode": "joint"}, {"delay_ms": 33.0}]
)
@pytest.mark.parametrize("name", ["paper", "free"])
def test_compiled_runs_pause_for_a_hand(name: str, kind: str, keys: dict[str, Any]) -> None:
    scenario = load_scenario(name, at_m2(kind, **keys))
    log = SimulatedLog(scenario)
    run = FusedRun(scenario, keep=2000)
    run.advance_to(scenario.duration_s)
    for (_, rows), site in zip(run.pop_records(), scenario.names, strict=True):
        columns = scenario.layout(site).columns()
        for signal in SIGNALS:
            recorded = np.array(getattr(log[site], signal))
            assert rows[:, columns[signal]].tobytes() == recorded.tobytes(), signal


@pytest.mark.usefixtures("kept_consents")
@pytest.mark.parametrize("kind", ["Circle", "Follower"])
def test_a_log_repeats_a_hand_without_its_class(kind: str) -> None:
    log = without_code(tn.simulate("paper", at_m2(kind)))
    assert log["m2"].hand[-1, 0] == 1.0
    assert tn.verify(log, virtual=True).passed
    with pytest.raises(CodeWithheld, match=r"tests\.own_code:.* may not run"):
        tn.simulate(log)


def test_a_hand_sees_its_peers_after_the_delay() -> None:
    scenario = load_scenario("paper", {**at_m2(), "link.delay_ms": 200})
    seen: list[HandView] = []
    at = HandSite.find(scenario, "m2")
    assert at is not None
    player = HandPlayer(at, Follower(at.describe()))

    def take(site: Site, k: int) -> list[float]:
        if player.hand.is_decision_tick(k):
            seen.append(player.hand.build_view(k, site.arrays, scenario.layout("m2")))
        return player.track(site, k)

    log = SimulatedLog(scenario, hands={"m2": take})
    for view in seen[15:]:
        for peer, name in zip(view.peers, scenario.peers("m2"), strict=True):
            assert peer.tick == log["m2"].states[view.k - 1].used[name] <= view.k - 1 - 200
            assert np.array_equal(peer.q, log[name].q[peer.tick])
            assert np.array_equal(peer.tau_x, log[name].tau_x[peer.tick])
            assert peer.age_s == pytest.approx(1e-3 * (view.k - peer.tick))
        assert np.array_equal(view.q, log["m2"].q[view.k])
        assert np.array_equal(view.tau_x, log["m2"].tau_x[view.k - 1])


@pytest.mark.usefixtures("kept_consents")
@pytest.mark.parametrize("how", ["raise", "nan", "many", "far", "text"])
def test_a_hand_that_fails_lets_go_for_good(how: str) -> None:
    with pytest.warns(RuntimeWarning, match="Failing failed at tick 300"):
        log = tn.simulate("paper", at_m2("Failing", settings={"how": how, "at_s": 0.3}))
    texts = [event.text for event in log.events if event.kind == "hand"]
    assert [text for text in texts if "tests.own_code:Failing failed at tick 300: " in text]
    assert [text for text in texts if "is not asked again" in text]
    assert len([text for text in texts if "failed" in text]) == 1
    assert log["m2"].hand[305, 2] == 0.0
    assert log["m2"].hand[299, 2] == 1.0
    assert log["m2"].hand[450:, 0].max() == 0.0
    assert log.complete
    assert tn.verify(without_code(log)).passed


def test_letting_go_is_no_failure() -> None:
    log = tn.simulate("paper", at_m2("Failing", settings={"how": "let go", "at_s": 0.3}))
    texts = [event.text for event in log.events if event.kind == "hand"]
    assert ["failed" in text for text in texts] == [False, False]


@pytest.mark.parametrize(
    ("keys", "path", "problem"),
    [
        ({"class": "tests.own_code:Missing"}, "class", "defines no class Missing"),
        (
            {"class": "tests.own_code:NoHand"},
            "class",
            "NoHand is not a hand: the class has no act",
        ),
        (
            {"class": "nowhere:Hand"},
            "class",
            "the module nowhere, which nowhere:Hand names, was not found",
        ),
        ({"class": "tests.own_code"}, "class", "must be a class, as in 'my_policy:Reach'"),
        ({"class": 3}, "class", "must be a class"),
        ({"rate_hz": 333}, "rate_hz", "must divide the site's tick rate, 1000 Hz, but is 333"),
        ({"rate_hz": 5}, "rate_hz", "a whole number from 10 to 1000, Hz"),
        ({"delay_ms": -1}, "delay_ms", "a time from 0 to 1000 ms"),
        ({"turn_s": 2}, "turn_s", "unknown key"),
        (
            {"settings": {"turn": 2}},
            "hands",
            "has no argument turn; its __init__ takes the arguments",
        ),
        (
            {"mode": "force", "speed_limit_m_s": 1},
            "speed_limit_m_s",
            "applies only to a live hand with mode 'tip'",
        ),
    ],
)
def test_an_invalid_hand_is_refused(keys: dict[str, Any], path: str, problem: str) -> None:
    with pytest.raises(ScenarioError, match=problem) as refused:
        tn.simulate("paper", at_m2(**keys))
    assert refused.value.path.endswith(path)


@pytest.mark.usefixtures("kept_consents")
def test_a_plant_is_measured_and_its_control_repeated() -> None:
    log = without_code(tn.simulate("paper", with_plant()))
    assert log.scenario.external == ("s",)
    assert log.scenario.outside == ()
    checked = tn.verify(log, virtual=True)
    assert checked.passed
    assert "the motion of s was measured and is not judged" in checked.summary()
    with pytest.raises(CodeWithheld, match="may not run"):
        tn.simulate(log)


def test_own_plant_arm_differs_by_integrator_order() -> None:
    """Euler's steps against Runge-Kutta's: the difference halves with the period."""

    def apart(rate_hz: int) -> float:
        overrides = {"rate_hz": rate_hz, "duration_s": 1.0, "link.delay_ms": 50}
        built_in, plant = (
            tn.simulate("paper", {**more, **overrides}) for more in ({}, with_plant())
        )
        return float(np.abs(built_in["s"].q[-1] - plant["s"].q[-1]).max())

    coarse, fine = apart(500), apart(1000)
    assert 0.0 < fine < 0.01
    assert 1.5 < coarse / fine < 2.5


@pytest.mark.parametrize(
    ("how", "problem"),
    [
        ("raise", "RuntimeError: the belt is torn"),
        ("nan", "qd is .*not finite"),
        ("one", "q has 1 number, and the arm has 2 joints"),
        ("alone", "ValueError: not enough values"),
        ("nothing", "TypeError"),
        ("touch", "tau_x has 1 number"),
    ],
)
def test_failing_plants_are_named_and_end_runs(how: str, problem: str, tmp_path: Any) -> None:
    scenario = load_scenario("paper", with_plant("Torn", how=how))
    path = tmp_path / "torn.mcap"
    with pytest.raises(
        PlantFailed, match=rf"the plant tests\.own_code:Torn of s failed at tick 199: {problem}"
    ):
        record_virtual(scenario, path)
    log = tn.open_log(path)
    assert len(log["s"]) >= 199
    assert [event.text for event in log.events if event.kind == "failed"]
    assert tn.verify(log).passed


BODIES = {"box": [0.2, 0.2, 0.2], "lid": [0.4, 0.1, 0.02]}


@pytest.mark.usefixtures("kept_consents")
def test_bodies_of_a_plant_are_in_every_record() -> None:
    log = without_code(tn.simulate("paper", with_plant("Carousel", bodies=BODIES)))
    part = log["s"]
    half = 0.5 * (part.t_s[:, np.newaxis] + [0.0, 1.0])
    assert np.allclose(part.bodies[:, [3, 10]], np.cos(half), atol=1e-9)
    assert np.allclose(part.bodies[:, [6, 13]], np.sin(half), atol=1e-9)
    table = log.table("s")
    assert np.array_equal(table["lid_x_m"].values, part.bodies[:, 7])
    assert log["m1"].bodies.size == 0
    assert tn.verify(log, virtual=True).passed


@pytest.mark.parametrize(
    ("how", "problem"),
    [
        ("few", "instead of seven numbers for each of 2"),
        ("nan", "not finite"),
        ("short", "instead of seven"),
    ],
)
def test_infinite_bodies_end_the_run(how: str, problem: str) -> None:
    with pytest.raises(
        PlantFailed, match=f"Carousel of s failed at tick 99: ValueError: .*{problem}"
    ):
        tn.simulate("paper", with_plant("Carousel", bodies=BODIES, how=how))


@pytest.mark.parametrize(
    ("bodies", "kind", "problem"),
    [
        (BODIES, "Arm", r"Arm has no method poses\(\)"),
        (
            {"box": [0.2, 0.2]},
            "Carousel",
            r"three sizes in m, each above 0 and at most 100, but is \[0.2, 0.2\]",
        ),
        ({"box": [0.2, 0.2, -1.0]}, "Carousel", "three sizes in m"),
        (
            {"The Box": [1.0, 1.0, 1.0]},
            "Carousel",
            "the name of a body may contain only a to z",
        ),
        (3, "Carousel", r"the sizes of at most 32 bodies, as in \{ box"),
    ],
)
def test_invalid_bodies_are_refused(bodies: Any, kind: str, problem: str) -> None:
    with pytest.raises(ScenarioError, match=problem) as refused:
        tn.simulate("paper", with_plant(kind, bodies=bodies))
    assert refused.value.path.startswith("sites.s.plant.bodies")


@pytest.mark.parametrize("rate_hz", [1000, 400])
def test_compiled_runs_pause_for_a_plant(rate_hz: int) -> None:
    scenario = load_scenario(
        "paper", {**with_plant(), "duration_s": 1.0, "sites.s.rate_hz": rate_hz}
    )
    log = SimulatedLog(scenario)
    run = FusedRun(scenario, keep=2000, runs_plants=True)
    for until_s in (0.3, 0.3015, 1.0):
        run.advance_to(until_s)
    for (_, rows), site in zip(run.pop_records(), scenario.names, strict=True):
        columns = scenario.layout(site).columns()
        for signal in SIGNALS:
            recorded = np.array(getattr(log[site], signal))
            assert rows[:, columns[signal]].tobytes() == recorded.tobytes(), signal


def test_sweeps_refuse_a_plant() -> None:
    with pytest.raises(ScenarioError, match="is a user's own plant") as refused:
        FusedRun(load_scenario("paper", with_plant()))
    assert refused.value.path == "sites.s.plant"


def test_scenario_text_holds_code_by_hash() -> None:
    scenario: Scenario = load_scenario(
        "paper", {**at_m2(settings={"turn_s": 2.5}), **with_plant()}
    )
    again = load_scenario(scenario.text)
    assert again.sha256 == scenario.sha256
    assert again.sites["m2"].hands == scenario.sites["m2"].hands
    assert again.sites["s"].plant == scenario.sites["s"].plant


def test_a_person_takes_over_without_a_jump() -> None:
    """Both lead a moving slave in turn; ramps step q_id by no more than 1.2 times the motion itself."""
    person = {
        "kind": "tip_spring",
        "to_m": [1.6, 0.5],
        "stiffness_n_m": 300.0,
        "damping_n_s_m": 30.0,
    }
    ramps = [
        {"at_s": at_s, "dominance": "s", "to": {"m1": m1, "m2": 1.0 - m1}, "ramp_s": 1.0}
        for at_s, m1 in ((3.0, 0.9), (6.0, 0.1))
    ]
    overrides = {
        **at_m2(settings={"turn_s": 3.0}),
        "sites.m1.hands": [{**person, "move_start_s": 0.0, "move_end_s": 8.0}],
        "dominance.s": {"m1": 0.1, "m2": 0.9},
        "timeline": ramps,
        "duration_s": 9.0,
    }
    metrics = tn.metrics(tn.simulate("paper", overrides))
    assert metrics.run["takeovers"].value == 2
    assert 0.0 < metrics.run["takeover_s"].value <= 1.0
    assert 0.0 < metrics.run["lead_jump"].value <= 1.2
