"""Changes and orders in sentences, in logs of this program and of older ones."""

import json
from typing import Any, get_args

import pytest

from trilat_net.recorded_change import SiteOrder
from trilat_net.scenario.change import Change

CHANGES = {
    "m2 was stopped by the experimenter at 58.2 s": {
        "site": "m2",
        "order": "stop",
        "at_s": 58.213,
    },
    "the link m1->s was set to 300 ms by the experimenter, from 58.213 s on": {
        "link": "m1->s",
        "to": {"model": "constant", "delay_ms": 300.0},
        "at_s": 58.213,
    },
    "the shares of s were set to m1 0.75, m2 0.25 within 0.5 s by the experimenter, from 58.213 s on": {
        "dominance": "s",
        "to": {"m1": 0.75, "m2": 0.25, "s": 0.0},
        "ramp_s": 0.5,
        "at_s": 58.213,
    },
}


def event_of(table: dict[str, Any], text: str = "s takes in {}") -> tuple[str, str, str]:
    """Returns kind, text and command of an event, as older programs wrote them: the text quotes
    the command.
    """
    command = json.dumps(table)
    return "change", text.format(command), command


@pytest.mark.parametrize("sentence", CHANGES)
def test_a_change_is_a_sentence(sentence: str) -> None:
    table = CHANGES[sentence]
    assert Change(**table).describe("the experimenter") == sentence
    without = sentence.replace(" by the experimenter", "")
    assert Change(**table).describe() == without
    assert Change.describe_event(*event_of(table)) == without
    assert Change.describe_event(*event_of(table, sentence)) == sentence


@pytest.mark.parametrize("order", [order for order in get_args(SiteOrder) if order])
def test_every_order_is_a_sentence(order: str) -> None:
    change = Change(at_s=1.0, site="m1", order=order, ticks=int(order == "overrun"))  # type: ignore[arg-type]
    sentence = change.describe()
    assert "m1" in sentence
    assert sentence.endswith("1.0 s")
    assert not set("{}_") & set(sentence)
    assert "1 ticks" not in sentence


def test_the_source_of_a_stop_is_recovered() -> None:
    change = Change(at_s=58.2, site="m2", order="stop")
    for who in ("the experimenter", "the user of m1", "a watcher at a terminal"):
        assert Change.find_requester(change.describe(who)) == who
    assert Change.find_requester(change.describe()) == ""
    assert Change.find_requester("m2 follows its peers from t = 1.000 s") == ""


@pytest.mark.parametrize(
    "command", ["{", "{}", '{"at_s": "x"}', '{"at_s": 1.0, "link": "a->b"}', "[]", "3"]
)
def test_a_strangers_command_keeps_its_text(command: str) -> None:
    assert Change.describe_event("change", f"s takes in {command}", command)
