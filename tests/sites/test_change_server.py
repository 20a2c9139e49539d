"""Changes requested from a running site."""

import json
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sites.change_server import AHEAD_MS, MARKS_WAITING, MIN_RAMP_S, ChangeServer
from tests.net.local_bus import LocalNetwork
from trilat_net.core.step.site_arrays import MAX_CHANGES, MAX_RAMPS
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import CoreChange, Mode, TickInput
from trilat_net.net import topics
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.requests import ChangeReply, ChangeRequest
from trilat_net.net.wire import decode, encode
from trilat_net.scenario import Scenario, load_scenario

SESSION = "changes"
KEY = topics.key(SESSION, "s", topics.SET)
STOP = topics.key(SESSION, "s", topics.STOP)


class Asked:
    """A site `s` that listens, and a member that requests changes."""

    def __init__(
        self, scenario: Scenario | None = None, mode: Callable[[], Mode] = lambda: Mode.RUN
    ) -> None:
        network = LocalNetwork()
        self.scenario = scenario or load_scenario("paper")
        self._client: Bus = network.join()
        requests, stops = (network.join().query_inbox(key) for key in (KEY, STOP))
        self.changes = ChangeServer(self.scenario, "s", requests, mode, stops=stops)

    def send(self, payload: bytes, key: str = KEY) -> Inbox:
        return self._client.query(key, payload)

    def ask(self, k: int, key: str = KEY, **order: Any) -> tuple[list[CoreChange], ChangeReply]:
        replies = self.send(encode(ChangeRequest(**order)), key)
        taken = list(self.changes.pop_changes(k))
        answer = replies.poll()
        assert answer is not None
        return taken, decode(answer[1], ChangeReply)


@given(st.integers(0, 10_000))
def test_accepted_changes_name_their_recorded_first_tick(k: int) -> None:
    """The next record repeats the command, which holds from the tick of the answer on."""
    requests = Asked()
    (taken,), reply = requests.ask(k, link="m1->s", to={"delay_ms": 350.0, "loss": 0.05})
    assert reply.accepted
    assert reply.tick == k + AHEAD_MS
    assert requests.scenario.parse_core_change("s", taken.text) == taken
    assert taken.model is not None
    assert (taken.peer, taken.model.from_ns) == (0, reply.tick * 1_000_000)
    assert (taken.model.location, taken.model.loss_good) == (350_000.0, 0.05)


def test_changes_leave_unnamed_keys_unchanged() -> None:
    later = {"at_s": 1.0, "link": "m1->s", "to": {"loss": 0.25}}
    requests = Asked(load_scenario("paper", {"timeline": [later]}))
    (before,), _ = requests.ask(10, link="m1->s", to={"duplicate": 0.5})
    (after,), _ = requests.ask(1000, link="m1->s", to={"delay_ms": 10.0})
    (last,), _ = requests.ask(1001, link="m1->s", to={"playout_ms": 20.0})
    models = [taken.model for taken in (before, after, last)]
    assert [m and (m.location, m.loss_good, m.duplicate, m.playout_us) for m in models] == [
        (200_000.0, 0.0, 0.5, 0),
        (10_000.0, 0.25, 0.0, 0),
        (10_000.0, 0.25, 0.0, 20_000),
    ]


def test_shares_are_ramped_from_the_first_tick() -> None:
    (taken,), reply = Asked().ask(7, dominance="s", to={"m1": 0.9, "m2": 0.1}, ramp_s=2.0)
    first_ns = reply.tick * 1_000_000
    assert taken.ramp == (first_ns, first_ns + 2_000_000_000, (0.9, 0.1))


def test_dominance_is_ramped_for_every_sender() -> None:
    (taken,), _ = Asked().ask(7, dominance="s", to={"m1": 0.9, "m2": 0.1}, ramp_s=0.0)
    assert taken.ramp is not None
    assert taken.ramp.end_ns - taken.ramp.start_ns == round(MIN_RAMP_S * 1e9)
    assert json.loads(taken.text)["ramp_s"] == MIN_RAMP_S
    assert not Asked().ask(7, dominance="s", to={"m1": 0.9, "m2": 0.1}, ramp_s=-1.0)[1].accepted


def test_triangle_drags_of_a_minute_are_obeyed() -> None:
    """Thirty orders a second, as a page sends them; a flood within the time before they hold is refused."""
    requests = Asked()
    site = Site(requests.scenario.setup("s"))
    for n in range(1800):
        (taken,), _ = requests.ask(
            10 * n, dominance="s", to={"m1": 0.5 + n / 4000, "m2": 0.5 - n / 4000}
        )
        site.apply_change(taken, 10 * n * 1_000_000)
    replies = [
        requests.ask(19_000, dominance="s", to={"m1": 1.0, "m2": 0.0})[1]
        for _ in range(MAX_RAMPS + 1)
    ]
    assert [reply.accepted for reply in replies] == [True] * MAX_RAMPS + [False]


@pytest.mark.parametrize(
    ("order", "says"),
    [
        ({"link": "s->m1", "to": {"delay_ms": 1.0}}, "send the change to m1"),
        ({"link": "m1->s", "to": {"delay_ms": float("nan")}}, "delay_ms"),
        ({"link": "m1->s", "to": {"preset": "5gg"}}, "5g"),
        ({"link": "m1->s", "to": {"model": "trace", "file": "/etc/passwd"}}, "file"),
        ({"dominance": "s", "to": {"m1": 0.9, "m2": 0.2}}, "sum"),
        ({"dominance": "x", "to": {"m1": 1.0}}, "sites are"),
        ({"dominance": "m1", "to": {"m2": 0.5, "s": 0.5}}, "send the change to m1"),
        ({"to": {}}, "must name either a link"),
    ],
)
def test_impossible_changes_are_refused_with_the_reason(
    order: Mapping[str, Any], says: str
) -> None:
    taken, reply = Asked().ask(5, **order)
    assert taken == []
    assert not reply.accepted
    assert says in reply.text


GLIDES = load_scenario("free", {"on_stale.action": "glide"})


def apply_orders(batches: list[list[str]]) -> tuple[list[bool], Mode]:
    """Returns the orders that a waiting site accepts, and its final mode; a batch is requested
    in one tick.
    """
    site = Site(GLIDES.setup("s"))
    mode = Mode.WAITING
    replies = []
    requests = Asked(GLIDES, lambda: mode)
    for k in range(20):
        batch = batches[k] if k < len(batches) else ()
        replies += [requests.send(encode(ChangeRequest(order=order))) for order in batch]
        mode = site.step(TickInput(k, commands=list(requests.changes.pop_changes(k)))).mode
    answers = [answer for reply in replies if (answer := reply.poll())]
    assert len(answers) == len(replies)
    return [decode(answer[1], ChangeReply).accepted for answer in answers], mode


@given(st.lists(st.sampled_from(["stop", "enable", "reset"]), min_size=1, max_size=6))
def test_orders_of_one_tick_act_as_in_several(orders: list[str]) -> None:
    """`enable` behind a `stop` of the same tick used to be refused: the site was not stopped yet."""
    assert apply_orders([orders]) == apply_orders([[order] for order in orders])


def test_clients_of_other_versions_are_refused() -> None:
    taken, reply = Asked().ask(0, v=99, link="m1->s", to={"delay_ms": 1.0})
    assert taken == []
    assert "99" in reply.text


def test_invalid_orders_are_answered_and_harmless() -> None:
    requests = Asked()
    replies = [requests.send(payload) for payload in (b"", b"\xc1", b"x" * 70_000)]
    assert requests.changes.pop_changes(0) == []
    assert all(
        (answer := r.poll()) and not decode(answer[1], ChangeReply).accepted for r in replies
    )


def test_changes_after_the_runs_end_are_refused() -> None:
    taken, reply = Asked().ask(19_950, link="m1->s", to={"delay_ms": 1.0})
    assert taken == []
    assert "20000" in reply.text


def test_changes_in_a_run_are_bounded() -> None:
    """L6: the site's tables hold every change that was accepted, and one more is refused."""
    requests = Asked()
    site = Site(requests.scenario.setup("s"))
    for k in range(MAX_CHANGES):
        (taken,), _ = requests.ask(k, link="m1->s", to={"delay_ms": float(k)})
        assert site.step(TickInput(k, (), [taken])).cmd == [taken.text]
    assert requests.ask(MAX_CHANGES, link="m1->s", to={"delay_ms": 1.0})[0] == []


def test_marks_change_nothing_and_wait_for_events() -> None:
    requests = Asked()
    taken, reply = requests.ask(7, mark="the wall")
    assert (taken, reply.accepted, reply.tick) == ([], True, 7)
    assert requests.changes.marks == [(7, "the wall")]
    replies = [requests.ask(8, mark=str(n))[1] for n in range(MARKS_WAITING)]
    assert [reply.accepted for reply in replies] == [True] * (MARKS_WAITING - 1) + [False]


@pytest.mark.parametrize(
    "more",
    [
        {"order": "enable"},
        {"order": "reset"},
        {"stop_s": 1.0},
        {"mark": "x"},
        {"link": "m1->s", "to": {"delay_ms": 1.0}},
        {"order": "stop", "mark": "x"},
    ],
)
def test_every_members_key_allows_stop_only(more: dict[str, Any]) -> None:
    requests = Asked(load_scenario("paper", {"on_stale.action": "glide"}))
    garbage = requests.send(b"garbage", STOP)
    taken, reply = requests.ask(10, STOP, **more)
    assert (taken, reply.accepted) == ([], False)
    assert "only requests to stop" in reply.text
    assert (answer := garbage.poll()) is not None
    assert not decode(answer[1], ChangeReply).accepted
    (change,), reply = requests.ask(11, STOP, order="stop")
    assert reply.accepted
    assert '"order":"stop"' in change.text


def test_orderers_are_kept_until_an_event() -> None:
    requests = Asked(load_scenario("paper", {"on_stale.action": "glide"}))
    (taken,), reply = requests.ask(5, STOP, order="stop", source="the experimenter")
    assert reply.accepted
    assert requests.changes.sources == {taken.text: "the experimenter"}
    assert "experimenter" not in taken.text  # the record, and so every execution, is the same
    (other,), _ = requests.ask(6, STOP, order="stop")
    assert other.text not in requests.changes.sources


def test_marks_claim_no_change() -> None:
    requests = Asked()
    for order in (
        {"link": "m1->s", "to": {"loss": 0.5}, "source": "m1"},
        {"mark": "here", "source": "m2"},
    ):
        requests.send(encode(ChangeRequest(**order)))
    (change,) = requests.changes.pop_changes(10)
    assert requests.changes.sources == {change.text: "m1"}


def test_request_without_source_has_the_old_bytes() -> None:
    """A site of an older program refuses a field that it does not know."""
    assert b"source" not in encode(ChangeRequest(order="stop"))
