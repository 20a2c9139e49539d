"""Orders of pages reach the sites of their session, one at a time."""

import pytest
from trilat_people.live_page.page_orders import OrderDesk, PageMessage

from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from trilat_net.net.requests import ChangeReply, ChangeRequest
from trilat_net.net.wire import decode, encode

MARK = '{"do":"mark","text":"contact"}'


def accept_before_all_run(desk: OrderDesk, text: str, first_site: str) -> None:
    """Gives a desk the message of a page while no view of a site exists."""
    order = PageMessage.read(text)
    desk.accept(order, sites=(), links=(), first_site=first_site)  # type: ignore[arg-type]


def test_marks_are_sent_before_all_sites_run() -> None:
    """The first site of the scenario publishes the mark, and its reply reaches the pages."""
    network = LocalNetwork()
    requests = network.join().query_inbox("trilat/s1/m1/set")
    desk = OrderDesk(network.join(), ManualClock(), "s1")
    accept_before_all_run(desk, MARK, "m1")
    desk.poll()
    query = requests.poll()
    assert query is not None
    assert decode(query.payload, ChangeRequest) == ChangeRequest(mark="contact")
    query.reply(encode(ChangeReply(member="m1", accepted=True, text="marked")))
    desk.poll()
    assert desk.replies == [("m1", "set", True, "marked")]


def test_marks_without_scenario_are_not_sent() -> None:
    """No site is known that could publish the mark."""
    network = LocalNetwork()
    requests = network.join().query_inbox("trilat/s1/*/set")
    desk = OrderDesk(network.join(), ManualClock(), "s1")
    accept_before_all_run(desk, MARK, "")
    desk.poll()
    assert requests.poll() is None
    assert desk.replies == []


@pytest.mark.parametrize(
    ("order", "reason"),
    [
        ('{"do":"shares","site":"m1","to":{"s":1.0}}', "no such site"),
        ('{"do":"release","order":"enable","sites":["m1"]}', "no such site"),
        ('{"do":"link","link":"m1->s","to":{"delay_ms":1.0}}', "no such link"),
    ],
)
def test_other_orders_wait_for_the_sites(order: str, reason: str) -> None:
    """Before all sites run, an order for a site or link is refused and counted."""
    desk = OrderDesk(LocalNetwork().join(), ManualClock(), "s1")
    accept_before_all_run(desk, order, "m1")
    assert desk.refused == {reason: 1}
