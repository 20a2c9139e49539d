"""Changes during a run, by a script and by command: complete in themselves, and with equal effect."""

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenario.links import draw_link
from trilat_net.core.links.delay import DelayKind, LinkModel
from trilat_net.core.step.ticks import DominanceRamp, first_tick_at
from trilat_net.errors import ScenarioError
from trilat_net.execution import virtual
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.run_changes import LinkTables, resolve_change

S = 10**9
LINK = {"at_s": 8.0, "link": "m1->s", "to": {"delay_ms": 350.0}}
ROW = {"at_s": 10.0, "dominance": "s", "to": {"m1": 0.9, "m2": 0.1}, "ramp_s": 2.0}


def make_scripted_scenario(*changes: Any, **overrides: Any) -> Scenario:
    return load_scenario("paper", {"timeline": list(changes), **overrides})


def test_link_changes_hold_from_then_on() -> None:
    setup = make_scripted_scenario(
        LINK, {"at_s": 9, "link": "m1->s", "to": {"loss": 0.5}}
    ).setup("s")
    assert setup.links[0].models == (
        LinkModel(location=200_000.0),
        LinkModel(from_ns=8 * S, location=350_000.0),
        LinkModel(from_ns=9 * S, location=350_000.0, loss_good=0.5),
    )
    assert setup.links[1].models == (LinkModel(location=200_000.0),)


def test_a_change_of_shares_is_a_ramp() -> None:
    scenario = make_scripted_scenario(
        LINK, ROW, {"at_s": 11, "dominance": "s", "to": {"m2": 1}}
    )
    assert scenario.setup("s").ramps == (
        DominanceRamp(10 * S, 12 * S, (0.9, 0.1)),
        DominanceRamp(11 * S, 11 * S, (0.0, 1.0)),
    )
    assert scenario.setup("m1").ramps == ()


def test_changes_keep_unnamed_keys() -> None:
    base = {
        "model": "gamma",
        "delay_ms": 50.0,
        "deviation_ms": 10.0,
        "loss": 0.1,
        "outages_s": [[1, 2]],
    }
    first = {"at_s": 1, "link": "m1->s", "to": {"deviation_ms": 5}}
    then = {"at_s": 2, "link": "m1->s", "to": {"preset": "4g"}}
    last = {"at_s": 3, "link": "m1->s", "to": {"model": "measured", "loss": 0.2}}
    scenario = make_scripted_scenario(first, then, last, link=base)
    assert [change.after.describe() for change in scenario.timeline] == [
        "gamma 50 +- 5 ms, loss 10 %, cut 1-2 s",
        "hyperexponential 53 +- 87.8 ms, cut 1-2 s",
        "measured, loss 20 %, cut 1-2 s",
    ]
    assert scenario.setup("s").links[0].outages == ((S, 2 * S),)


def test_a_change_may_end_a_trace() -> None:
    base = {"model": "trace", "trace": "0 7000, 1000 9000"}
    left = [
        {"at_s": 1, "link": "m1->s", "to": {"loss": 0.5}},
        {"at_s": 2, "link": "m1->s", "to": {"preset": "lan"}},
    ]
    links_of_s = make_scripted_scenario(*left, link=base).setup("s").links
    assert [model.kind for model in links_of_s[0].models] == [
        DelayKind.TRACE,
        DelayKind.TRACE,
        DelayKind.GAMMA,
    ]
    assert [trace is not None for trace in links_of_s[0].traces] == [True, True, False]


def test_two_changes_may_share_a_time() -> None:
    assert make_scripted_scenario(LINK, {**LINK, "to": {"delay_ms": 1}}).timeline[1].at_s == 8.0


# By command.


def resolve_order(scenario: Scenario, written: dict[str, Any], from_ns: int = S) -> Any:
    return resolve_change(scenario, LinkTables(scenario.links, ()), written, from_ns)


def test_commands_hold_from_their_tick_at_receivers() -> None:
    scenario = load_scenario("paper")
    change = resolve_order(
        scenario, {"link": "m1->s", "to": {"delay_ms": 350, "loss": 0.05}}, 123_456_789
    )
    assert (change.owner, change.start_ns) == ("s", 123_456_789)
    change_made = scenario.to_core_change(change)
    assert (change_made.peer, change_made.model) == (
        0,
        LinkModel(from_ns=123_456_789, location=350_000.0, loss_good=0.05),
    )
    change = resolve_order(scenario, {"dominance": "m2", "to": {"s": 1}, "ramp_s": 0.5}, 2 * S)
    assert change.owner == "m2"
    assert scenario.to_core_change(change).ramp == DominanceRamp(
        2 * S, 2_500_000_000, (0.0, 1.0)
    )


@settings(max_examples=60)
@given(to=draw_link(without=("trace",)), from_ns=st.integers(0, 10**14))
def test_recorded_commands_are_restored(to: dict[str, Any], from_ns: int) -> None:
    scenario = load_scenario("paper")
    to.pop("outages_s", None)
    change = scenario.to_core_change(
        resolve_order(scenario, {"link": "s->m1", "to": to}, from_ns)
    )
    assert scenario.parse_core_change("m1", change.text) == change
    assert change.model is not None
    assert change.model.from_ns == from_ns


@pytest.mark.parametrize("change", [LINK, ROW], ids=["link", "shares"])
def test_commands_equal_the_script(change: dict[str, Any]) -> None:
    """The same trajectories, bit for bit, and the record of its tick names the command."""
    at_ns = 300_000_000
    short = {
        "duration_s": 1.0,
        "link": {"model": "uniform", "delay_ms": 20.0, "half_width_ms": 10.0},
    }
    script = {**change, "at_s": at_ns / S, **({"ramp_s": 0.2} if "dominance" in change else {})}
    if "link" in change:
        script["to"] = {"model": "constant", "delay_ms": 60.0}
    plain = load_scenario("free", short)
    planned = load_scenario("free", {**short, "timeline": [script]})
    written = {key: value for key, value in script.items() if key != "at_s"}
    change_made = plain.to_core_change(resolve_order(plain, written, at_ns))
    k = first_tick_at(at_ns, 1000) - 100
    commanded = list(virtual.execute_virtual(plain, commands={"s": {k: [change_made]}}))
    scripted_run = list(virtual.execute_virtual(planned))
    assert [step.output._replace(cmd=[]) for step in commanded] == [
        step.output for step in scripted_run
    ]
    named = [step.output for step in commanded if step.output.cmd]
    assert [(output.tick, output.cmd) for output in named] == [(k, [change_made.text])]
    assert commanded != list(virtual.execute_virtual(plain))


@pytest.mark.parametrize(
    ("written", "phrase"),
    [
        ({"link": "m1->x", "to": {}}, "no link 'm1->x'"),
        ({"link": "m1->s", "dominance": "s"}, "must name either a link"),
        ({"link": "m1->s", "to": {"model": "trace", "trace": "0 5"}}, "trace"),
        ({"link": "m1->s", "to": {"delay_ms": 5}, "ramp_s": 1.0}, "only shares have a ramp"),
        ({"dominance": "s", "to": {"m1": 1}, "ramp_s": -1.0}, "ramp_s"),
    ],
)
def test_impossible_orders_are_refused(written: dict[str, Any], phrase: str) -> None:
    with pytest.raises(ScenarioError, match=phrase):
        resolve_order(load_scenario("paper"), written)


def test_links_with_traces_refuse_unrecordable_orders() -> None:
    scenario = load_scenario("paper", {"link": {"model": "trace", "trace": "0 7000"}})
    with pytest.raises(ScenarioError, match="can be changed only by setting another model"):
        resolve_order(scenario, {"link": "m1->s", "to": {"loss": 0.5}})
    assert (
        scenario.to_core_change(
            resolve_order(scenario, {"link": "m1->s", "to": {"preset": "lan"}})
        ).model
        is not None
    )


good = {"at_s": 1.0, "link": "m1->s", "to": {"model": "constant", "delay_ms": 5.0}}
row = {"at_s": 1.0, "dominance": "s", "to": {"m1": 0.5, "m2": 0.5}}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        json.dumps({**good, "more": 1}),
        json.dumps({**good, "link": "m1->m2"}),
        json.dumps({**good, "dominance": "s"}),
        json.dumps({**good, "to": {"model": "constant", "delay_ms": -5}}),
        json.dumps(
            {**good, "to": {"model": "constant", "delay_ms": 5, "loss": 1, "loss_burst": 2}}
        ),
        json.dumps({**good, "at_s": -1}),
        json.dumps({**row, "dominance": "m1"}),
        json.dumps({**row, "to": {"m1": "half"}}),
        json.dumps({**row, "to": {"m1": 0.5}}),
    ],
)
def test_records_of_unknown_commands_are_refused(text: str) -> None:
    scenario = load_scenario("paper")
    for valid in (good, row):
        assert (
            scenario.parse_core_change("s", json.dumps(valid)).text
            == msgspec.json.encode(valid).decode()
        )
    with pytest.raises(ScenarioError):
        scenario.parse_core_change("s", text)
