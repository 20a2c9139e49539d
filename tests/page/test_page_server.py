"""Whom the page's server refuses: foreign pages, strangers without the token, floods, nonsense."""

import json
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from socket import create_server
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from live.live_session import PageOptions
from live.page_orders import MAX_MESSAGE_BYTES, MoveHand, PageHands
from live.page_server import MOST_EXCESS, PageServer
from tests.cli.running import trilat
from tests.net.waiting import drained, until
from trilat_net.errors import UsageError
from trilat_net.net.bus import LocalBus, LocalNetwork
from trilat_net.net.clock import SystemClock
from trilat_net.net.requests import ChangeReply, ChangeRequest, HandMessage
from trilat_net.net.wire import decode, encode


@pytest.fixture
def network() -> LocalNetwork:
    return LocalNetwork()


@pytest.fixture
def server(network: LocalNetwork) -> Iterator[PageServer]:
    with PageServer(network.join(), SystemClock(), "s1") as made:
        yield made


def socket(server: PageServer, origin: str | None = None, host: str | None = None) -> ClientConnection:
    address = urlsplit(server.address)
    there = f"ws://{address.netloc}/socket?{address.query}"
    headers = {} if host is None else {"Host": host}
    return connect(there, origin=origin, additional_headers=headers, max_size=None)


def get(server: PageServer, path: str, **headers: str) -> tuple[int, str, bytes]:
    connection = HTTPConnection(urlsplit(server.address).netloc, timeout=5)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.headers["Content-Security-Policy"] or "", answer.read()


def hears(client: ClientConnection) -> dict[str, object]:
    return json.loads(client.recv(timeout=5))  # type: ignore[no-any-return]


def flood(client: ClientConnection, count: int) -> None:
    for _ in range(count):
        client.send('{"do":"seen","n":0}')


def test_it_serves_its_own_files_and_no_others(server: PageServer) -> None:
    status, policy, page = get(server, "/")
    assert status == 200
    assert b'src="main.js"' in page
    assert "default-src 'none'" in policy
    for name in (
        "main.js",
        "painter3d.js",
        "three.module.min.js",
        "uPlot.iife.min.js",
        "page.css",
        "three-LICENSE",
    ):
        assert get(server, f"/{name}")[0] == 200, name
    for name in (
        "../pyproject.toml",
        "page_server.py",
        "report.html",
        "%2e%2e/live_session.py",
        "nothing.js",
    ):
        assert get(server, f"/{name}")[0] == 404, name


def test_a_page_of_another_site_gets_no_socket(server: PageServer) -> None:
    for origin in ("http://evil.example", "null", server.address.replace("http", "https").rstrip("/")):
        with pytest.raises(InvalidStatus, match="403"):
            socket(server, origin)
    assert server.refused["foreign origin"] == 3
    with socket(server, server.address.rstrip("/")) as own:
        assert "hello" in hears(own)


def test_a_name_of_somebody_elses_that_leads_here_is_refused(server: PageServer) -> None:
    """Against pages that resolve their own name to loopback."""
    assert get(server, "/", Host="evil.example")[0] == 403
    assert server.refused["foreign host"] == 1


def test_a_port_in_use_is_found_before_a_folder_is_made(tmp_path: Path) -> None:
    with create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        done = trilat("live", "two_sites", "--port", str(port), "--no-browser", cwd=tmp_path)
    done.refuses(f"127.0.0.1:{port}: cannot listen: Address already in use")
    assert not list(tmp_path.iterdir())
    PageOptions(port=port).check()


def test_another_address_than_loopback_demands_insecure_and_a_token(network: LocalNetwork) -> None:
    with pytest.raises(UsageError, match="insecure=True"):
        PageOptions(host="0.0.0.0").check()
    PageOptions(host="0.0.0.0", insecure=True).check()
    with PageServer(network.join(), SystemClock(), "s1", host="0.0.0.0") as server:
        token = urlsplit(server.address).query
        assert len(token) > len("token=") + 20
        for query in ("", "?token=", "?token=guess", f"?{token}x"):
            assert get(server, f"/{query}")[0] == 403
        assert get(server, f"/?{token}")[0] == 200
        assert server.refused["no token"] == 4


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "malformed"),
        ("[1]", "malformed"),
        ('{"do":"shutdown"}', "malformed"),
        ('{"do":"link","link":"m1->s","to":{"delay_ms":NaN}}', "malformed"),
        ('{"do":"link","link":"m1->s","to":{"delay_ms":1e999}}', "malformed"),
        ('{"do":"shares","site":"s","to":{"m1":1.0},"also":1}', "malformed"),
        ('{"do":"seen","n":-1}', "malformed"),
        ("[" * 2000, "malformed"),
        ('{"do":"shares","site":"*","to":{"m1":1.0}}', "no such site"),
        ('{"do":"link","link":"m1->s/x","to":{"delay_ms":1}}', "no such site"),
    ],
)
def test_nonsense_is_counted_and_dropped(server: PageServer, text: str, reason: str) -> None:
    with socket(server) as page:
        page.send(text)
        until(lambda: server.refused[reason] == 1)
        page.send(b"\xff\xfe")
        until(lambda: server.refused.total() == 2)
        assert "hello" in hears(page)


def test_ten_megabytes_and_a_hundred_thousand_messages_end_the_connection(server: PageServer) -> None:
    with socket(server) as page:
        page.send("x" * (10 << 20))
        with pytest.raises(ConnectionClosed) as closed:
            until(lambda: hears(page) and False)
        assert closed.value.rcvd is None or closed.value.rcvd.code == 1009
    until(lambda: server.refused["too large"] == 1)
    with socket(server) as hostile, pytest.raises(ConnectionClosed):
        flood(hostile, 100_000)
    assert server.refused["too many"] == MOST_EXCESS + 1
    with socket(server) as page:
        page.send("x" * (MAX_MESSAGE_BYTES - 2))
        assert "hello" in hears(page)


def test_orders_count_of_a_page_that_takes_part_and_a_second_one_asks_first(
    network: LocalNetwork, server: PageServer
) -> None:
    site: LocalBus = network.join()
    questions = site.questions("trilat/s1/s/set")
    order = '{"do":"link","link":"m1->s","to":{"delay_ms":300,"deviation_ms":0,"loss":0}}'
    with socket(server) as first, socket(server) as second:
        hears(first), hears(second)
        second.send(order)
        until(lambda: server.refused["does not take part"] == 1)
        assert questions.poll() is None
        for n in range(50):
            first.send(order.replace("300", str(n)))
        delays_ms = []
        while delays_ms[-1:] != [49.0]:  # the newest is asked for; of those before, hardly any
            query = until(questions.poll)
            delays_ms.append(decode(query.payload, ChangeRequest).to["delay_ms"])
            query.answer(encode(ChangeReply(member="s", accepted=True, text="")))
        assert len(delays_ms) < 20
        second.send('{"do":"control","want":true}')
        second.send(order)
        assert decode(until(questions.poll).payload, ChangeRequest).link == "m1->s"
    assert server.refused["does not take part"] == 1


def test_what_a_page_wants_of_a_hand_is_in_range_or_refused(server: PageServer) -> None:
    """An arm that is not there, or that nobody can hold, is refused; so is what is no number."""
    with socket(server) as page:
        page.send('{"do":"hand","site":"m1","grip":true,"to":[1.0,0.5]}')
        until(lambda: server.refused["nobody can hold it"] == 1)
        for to in ("[NaN,0]", "[1e999,0]", '["1",0]', str([0.0] * 13)):
            page.send(f'{{"do":"hand","site":"m1","grip":true,"to":{to}}}')
        until(lambda: server.refused["malformed"] == 4)
        assert "hello" in hears(page)


def test_the_hands_of_a_page_are_its_own_and_let_go_with_it(network: LocalNetwork) -> None:
    site = network.join()
    messages = site.inbox("trilat/s1/m1/hand")
    hands = [PageHands(network.join(), SystemClock(), "s1", f"page {n}") for n in (1, 2)]
    for hand in hands:
        hand.move(MoveHand(site="m1", grip=True, to=[1.0, 0.5]), pushes=False)
    hands[0].move(MoveHand(site="m1", grip=True, to=[1.1, 0.5]), pushes=False)
    hands[0].release()
    hands[0].release()
    sent = [decode(payload, HandMessage) for _, payload in drained(messages)]
    assert [(one.source, one.n, one.grip, one.target) for one in sent] == [
        ("page 1", 1, True, [1.0, 0.5]),
        ("page 2", 1, True, [1.0, 0.5]),
        ("page 1", 2, True, [1.1, 0.5]),
        ("page 1", 3, False, []),
    ]
    assert hands[0].holds("m1", sent[0].boot)
    assert not hands[1].holds("m1", sent[0].boot)
    assert sent[0].boot != sent[1].boot
