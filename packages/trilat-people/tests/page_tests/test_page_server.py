"""Whom the page's server refuses: foreign pages, strangers without the token, floods, nonsense."""

import contextlib
import json
import ssl
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from pathlib import Path
from socket import SHUT_WR, create_connection, create_server
from urllib.parse import urlsplit

import pytest
from trilat_people.live_page.page_entrance import MAX_PAGES, MAX_STRANGERS
from trilat_people.live_page.page_opening import BrowserOpening
from trilat_people.live_page.page_orders import MAX_MESSAGE_BYTES, MoveHand, PageHands
from trilat_people.live_page.page_server import (
    MAX_EXCESS,
    REQUEST_TIMEOUT_S,
    PageOptions,
    PageServer,
)
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from tests.cli.running import trilat
from tests.live.page_client import socket_address, with_query
from tests.net.local_bus import LocalBus, LocalNetwork
from tests.net.waiting import drained, until
from trilat_net.errors import UsageError
from trilat_net.net.clock import SystemClock
from trilat_net.net.member_keys import create_keys
from trilat_net.net.requests import ChangeReply, ChangeRequest, HandMessage
from trilat_net.net.wire import decode, encode
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.scenario import load_scenario


@pytest.fixture
def network() -> LocalNetwork:
    return LocalNetwork()


@pytest.fixture
def server(network: LocalNetwork) -> Iterator[PageServer]:
    """A server of the pages of a session without sites."""
    with PageServer(network.join(), SystemClock(), "s1") as page_server:
        yield page_server


def open_socket(
    server: PageServer, origin: str | None = None, link: str = ""
) -> ClientConnection:
    """Returns the socket of a page, at the link of a role or of the experimenter."""
    return connect(socket_address(link or server.address), origin=origin, max_size=None)


def get(server: PageServer, path: str, **headers: str) -> tuple[int, str, bytes]:
    """Returns the status, the security policy and the content at a path."""
    connection = HTTPConnection(urlsplit(server.address).netloc, timeout=5)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.headers["Content-Security-Policy"] or "", answer.read()


def receive(client: ClientConnection) -> dict[str, object]:
    """Returns the next message that a page gets."""
    return json.loads(client.recv(timeout=5))  # type: ignore[no-any-return]


def send_request(server: PageServer, request: bytes) -> bytes:
    """Sends bytes to the server, and returns all bytes of the answer."""
    address = urlsplit(server.address)
    with create_connection((address.hostname, address.port), 5) as connection:
        connection.sendall(request)
        if b"\r\n\r\n" not in request:
            connection.shutdown(SHUT_WR)
        return b"".join(iter(lambda: connection.recv(65_536), b""))


def flood(client: ClientConnection, count: int) -> None:
    """Sends many messages that a page has drawn a frame."""
    for _ in range(count):
        client.send('{"do":"seen","n":0}')


def test_only_own_files_are_served(server: PageServer) -> None:
    status, policy, page = get(server, "/")
    assert status == 200
    assert b'src="main.js"' in page
    assert "default-src 'none'" in policy
    for name in (
        "main.js",
        "painter3d.js",
        "three.module.min.js",
        "uPlot.iife.min.js",
        "theme.css",
        "page.css",
        "three-LICENSE",
    ):
        assert get(server, f"/{name}")[0] == 200, name
    for name in (
        "../pyproject.toml",
        "page_server.py",
        "report.html",
        "%2e%2e/page_server.py",
        "nothing.js",
    ):
        assert get(server, f"/{name}")[0] == 404, name


def test_a_page_of_another_site_gets_no_socket(server: PageServer) -> None:
    own_origin = server.address.partition("/#")[0]
    for origin in ("http://evil.example", "null", own_origin.replace("http", "https")):
        with pytest.raises(InvalidStatus, match="403"):
            open_socket(server, origin)
    assert server.refused["foreign origin"] == 3
    with open_socket(server, own_origin) as page:
        assert "hello" in receive(page)


def test_foreign_names_for_this_address_are_refused(server: PageServer) -> None:
    """Against pages that resolve their own name to loopback."""
    assert get(server, "/", Host="evil.example")[0] == 403
    assert server.refused["foreign host"] == 1


def test_ports_in_use_are_found_before_folders(tmp_path: Path) -> None:
    with create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        done = trilat("live", "two_sites", "--port", str(port), "--no-browser", cwd=tmp_path)
    done.refuses(f"127.0.0.1:{port}: cannot listen: Address already in use")
    assert not list(tmp_path.iterdir())
    PageOptions(port=port).check()


def test_another_address_than_loopback_demands_insecure() -> None:
    with pytest.raises(UsageError, match="insecure=True"):
        PageOptions(host="0.0.0.0").check()
    PageOptions(host="0.0.0.0", insecure=True).check()


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "0.0.0.0"])
def test_every_socket_needs_the_token_of_its_link(host: str, network: LocalNetwork) -> None:
    """On loopback too, which every user of the machine reaches."""
    with PageServer(network.join(), SystemClock(), "s1", PageOptions(host=host)) as server:
        token = urlsplit(server.address).fragment
        assert len(token) > len("token=") + 20
        for query in (
            "",
            "?token=",
            "?token=guess",
            f"?{token}x",
            "?token=%C3%A9",
            f"?as=m1&{token}x",
        ):
            assert get(server, f"/socket{query}")[0] == 403
        for query in ("?watch", "?as=m1"):
            assert get(server, f"/socket{query}")[0] == 403
        assert server.refused["no token"] == 8
        with open_socket(server) as page:
            assert "hello" in receive(page)
        assert get(server, "/")[0] == 200  # what everybody may read; a fragment is not sent


def test_pages_with_keys_are_encrypted_and_named(network: LocalNetwork, tmp_path: Path) -> None:
    """Page and socket, by the certificate of a member; beyond loopback nobody need say insecure."""
    (keys,) = create_keys(tmp_path / "keys", ["operator"])
    options = PageOptions(host="0.0.0.0", tls=keys)
    options.check()
    with PageServer(network.join(), SystemClock(), "s1", options) as server:
        assert server.address.startswith("https://0.0.0.0:")
        trusted = ssl.create_default_context(cafile=keys / "authority.pem")
        at, _, token = server.address.replace("0.0.0.0", "127.0.0.1").partition("#")
        page = HTTPSConnection(urlsplit(at).netloc, context=trusted, timeout=5)
        page.request("GET", "/")
        assert b"trilat live" in page.getresponse().read()
        wss = at.replace("https", "wss") + f"socket?{token}"
        with connect(wss, ssl=trusted, origin=Origin(at.rstrip("/"))) as client:
            assert "hello" in receive(client)
        with (
            pytest.raises(InvalidStatus, match="403"),
            connect(wss, ssl=trusted, origin=Origin("http://a")),
        ):
            pass
        with pytest.raises(ssl.SSLCertVerificationError):
            HTTPSConnection(urlsplit(at).netloc, context=ssl.create_default_context()).connect()
        with pytest.raises((OSError, HTTPException)):
            get(server, "/")  # without encryption


def test_unusable_keys_are_found_before_anything_begins(tmp_path: Path) -> None:
    create_keys(tmp_path / "keys", ["operator"])
    with pytest.raises(UsageError, match="name the folder of one member"):
        PageOptions(tls=tmp_path / "keys").check()
    with pytest.raises(UsageError, match="no keys made by `trilat keys new`"):
        PageOptions(tls=tmp_path).check()


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
        ('{"do":"link","link":"m1->s/x","to":{"delay_ms":1}}', "no such link"),
        ('{"do":"link","link":"s","to":{"delay_ms":1}}', "no such link"),
        ('{"do":"shares","site":"s","to":{"m1":1.0}}', "no such site"),
    ],
)
def test_nonsense_is_counted_and_dropped(server: PageServer, text: str, reason: str) -> None:
    with open_socket(server) as page:
        page.send(text)
        until(lambda: server.refused[reason] == 1)
        page.send(b"\xff\xfe")
        until(lambda: server.refused.total() == 2)
        assert "hello" in receive(page)


@pytest.mark.long
def test_megabytes_and_floods_end_the_connection(
    server: PageServer,
) -> None:
    with open_socket(server) as page:
        page.send("x" * (10 << 20))
        with pytest.raises(ConnectionClosed) as closed:
            until(lambda: receive(page) and False)
        assert closed.value.rcvd is None or closed.value.rcvd.code == 1009
    until(lambda: server.refused["too large"] == 1)
    with open_socket(server) as hostile, pytest.raises(ConnectionClosed):
        flood(hostile, 100_000)
    assert server.refused["too many"] == MAX_EXCESS + 1
    with open_socket(server) as page:
        page.send("x" * (MAX_MESSAGE_BYTES - 2))
        assert "hello" in receive(page)


def test_only_participating_pages_give_orders(
    network: LocalNetwork, server: PageServer
) -> None:
    site: LocalBus = network.join()
    questions = site.query_inbox("trilat/s1/s/set")
    server.view.links = {"m1->s": {}}
    order = '{"do":"link","link":"m1->s","to":{"delay_ms":300,"deviation_ms":0,"loss":0}}'
    with open_socket(server) as first, open_socket(server) as second:
        receive(first)
        receive(second)
        second.send(order)
        until(lambda: server.refused["does not take part"] == 1)
        assert questions.poll() is None
        for n in range(50):
            first.send(order.replace("300", str(n)))
        delays_ms = []
        while delays_ms[-1:] != [49.0]:  # the newest is asked for; of those before, hardly any
            query = until(questions.poll)
            delays_ms.append(decode(query.payload, ChangeRequest).to["delay_ms"])
            query.reply(encode(ChangeReply(member="s", accepted=True, text="")))
        assert len(delays_ms) < 20
        second.send('{"do":"control","want":true}')
        second.send(order)
        assert decode(until(questions.poll).payload, ChangeRequest).link == "m1->s"
    assert server.refused["does not take part"] == 1


def test_hand_requests_are_in_range_or_refused(server: PageServer) -> None:
    """An arm that is not there, or that nobody can hold, is refused; so is what is no number."""
    with open_socket(server) as page:
        page.send('{"do":"hand","site":"m1","grip":true,"to":[1.0,0.5]}')
        until(lambda: server.refused["nobody can hold it"] == 1)
        for to in ("[NaN,0]", "[1e999,0]", '["1",0]', str([0.0] * 13)):
            page.send(f'{{"do":"hand","site":"m1","grip":true,"to":{to}}}')
        until(lambda: server.refused["malformed"] == 4)
        assert "hello" in receive(page)


def test_pages_hands_end_with_their_page(network: LocalNetwork) -> None:
    site = network.join()
    messages = site.inbox("trilat/s1/m1/hand")
    hands = [PageHands(network.join(), SystemClock(), "s1", f"page {n}") for n in (1, 2)]
    for hand in hands:
        hand.move(MoveHand(site="m1", grip=True, to=[1.0, 0.5]), pushes=False)
    hands[0].move(MoveHand(site="m1", grip=True, to=[1.1, 0.5]), pushes=False)
    hands[0].release()
    hands[0].release()
    sent = [decode(payload, HandMessage) for _, payload in drained(messages)]
    assert [(message.source, message.n, message.grip, message.target) for message in sent] == [
        ("page 1", 1, True, [1.0, 0.5]),
        ("page 2", 1, True, [1.0, 0.5]),
        ("page 1", 2, True, [1.1, 0.5]),
        ("page 1", 3, False, []),
    ]
    assert hands[0].holds("m1", sent[0].boot)
    assert not hands[1].holds("m1", sent[0].boot)
    assert sent[0].boot != sent[1].boot


@pytest.mark.parametrize(
    "request_",
    [
        b"GET //[ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: [\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: a\r\nOrigin: b\r\n\r\n",
        b"GET /\xff HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\n\r\nx",
        b"\x16\x03\x01\x00\xa5\x01\x00\x00\xa1",
        b"GET / HT",
    ],
)
def test_invalid_requests_get_400_and_are_counted(
    server: PageServer, request_: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    assert send_request(server, request_).startswith(b"HTTP/1.1 400 ")
    assert server.refused == {"malformed request": 1}
    assert send_request(server, b"") == b""  # a connection that is opened ahead is not counted
    assert get(server, "/")[0] == 200
    assert server.refused.total() == 1
    assert capfd.readouterr() == ("", "")


def test_a_socket_that_breaks_the_protocol_is_counted(server: PageServer) -> None:
    with open_socket(server) as page:
        page.socket.sendall(b"\xff" * 64)
        until(lambda: server.refused["broken frames"] == 1)
    request = (
        f"GET /socket?{urlsplit(server.address).fragment} HTTP/1.1\r\nHost: localhost\r\n\r\n"
    )
    assert send_request(server, request.encode()).startswith(b"HTTP/1.1 426 ")
    assert server.refused["malformed request"] == 1


def test_marks_hands_and_control_have_rate_limits(server: PageServer) -> None:
    with open_socket(server) as page:
        for _ in range(50):
            page.send('{"do":"mark","text":"a"}')
            page.send('{"do":"control","want":true}')
        until(lambda: server.refused["too many: mark"] > 35)
        assert server.refused["too many: control"] > 35
        assert "hello" in receive(page)
    with open_socket(server) as page:
        for _ in range(450):
            page.send('{"do":"hand","site":"m1","grip":true,"to":[1.0,0.5]}')
        until(
            lambda: (
                server.refused["nobody can hold it"] + server.refused["too many: hand"] == 450
            )
        )
        refused = server.refused["nobody can hold it"]
        page.send('{"do":"hand","site":"m1","grip":false}')
        until(lambda: server.refused["nobody can hold it"] == refused + 1)


def test_any_page_stops_every_arm_at_once(network: LocalNetwork, server: PageServer) -> None:
    site: LocalBus = network.join()
    changes = site.query_inbox("trilat/s1/s/set")
    stops = site.query_inbox("trilat/s1/s/stop")
    server.view.sites = {"s": None}  # type: ignore[dict-item]
    server.view.links = {"m1->s": {}}  # type: ignore[dict-item]
    with open_socket(server) as first, open_socket(server) as second:
        receive(first)
        receive(second)
        first.send('{"do":"link","link":"m1->s","to":{"delay_ms":1}}')
        until(changes.poll)  # nobody answers
        second.send('{"do":"stop"}')
        query = until(stops.poll)
        assert decode(query.payload, ChangeRequest) == ChangeRequest(
            order="stop", source="the experimenter"
        )
        second.send('{"do":"shares","site":"s","to":{"m1":1.0}}')
        until(lambda: server.refused["does not take part"] == 1)


def test_experimenters_release_arms_until_a_stop(
    network: LocalNetwork, server: PageServer
) -> None:
    site: LocalBus = network.join()
    changes = site.query_inbox("trilat/s1/s/set")
    stops = site.query_inbox("trilat/s1/s/stop")
    server.view.sites = {"s": None}  # type: ignore[dict-item]
    server.view.links = {"m1->s": {}}  # type: ignore[dict-item]
    with open_socket(server) as page:
        receive(page)
        page.send('{"do":"release","order":"enable","sites":["s"]}')
        query = until(changes.poll)  # nobody answers
        released = ChangeRequest(order="enable", source="the experimenter")
        assert decode(query.payload, ChangeRequest) == released
        page.send('{"do":"release","order":"enable","sites":["s"]}')  # waits for that answer
        page.send('{"do":"stop"}')
        until(stops.poll)
        query.reply(encode(ChangeReply(member="s", accepted=True, text="s: enable at tick 5")))
        # is asked after whatever waits
        page.send('{"do":"link","link":"m1->s","to":{"delay_ms":1}}')
        query = until(changes.poll)
        assert decode(query.payload, ChangeRequest).link == "m1->s"
        page.send('{"do":"release","order":"enable","sites":["s","unknown"]}')
        until(lambda: server.refused["no such site"] == 1)
        for wrong in ('"stop","sites":["s"]', '"enable","sites":[]', '"enable","sites":"s"'):
            page.send('{"do":"release","order":' + wrong + "}")
        until(lambda: server.refused["malformed"] == 3)


def test_stops_refused_by_older_sites_are_repeated(
    network: LocalNetwork, server: PageServer
) -> None:
    """A stop that names its source is repeated without it for a site that refuses sources."""
    stops = network.join().query_inbox("trilat/s1/s/stop")
    server.view.sites = {"s": None}  # type: ignore[dict-item]
    with open_socket(server) as page:
        receive(page)
        page.send('{"do":"stop"}')
        query = until(stops.poll)
        query.reply(encode(ChangeReply(member="s", accepted=False, text="malformed")))
        again = until(stops.poll)
        assert decode(again.payload, ChangeRequest) == ChangeRequest(order="stop")


def test_inner_failures_are_counted_and_reported(capfd: pytest.CaptureFixture[str]) -> None:
    """Names that Zenoh takes for expressions: no session has them, and the bus refuses them."""
    said: list[str] = []
    with (
        closing(ZenohBus()) as bus,
        PageServer(bus, SystemClock(), "s1", say=said.append) as server,
    ):
        server.view.sites = {"a#b": None}  # type: ignore[dict-item]
        server.view.links = {"m1->a#b": {}}  # type: ignore[dict-item]
        with open_socket(server) as page:
            for _ in range(3):
                page.send('{"do":"stop"}')
            until(lambda: server.refused["message failed: ZError"] == 3)
            for _ in range(3):
                page.send('{"do":"link","link":"m1->a#b","to":{"delay_ms":1.0}}')
                page.send('{"do":"shares","site":"a#b","to":{"m1":1.0}}')
            until(lambda: server.refused["OrderDesk.poll failed: ZError"] > 1)
            page.send("nonsense")
            until(lambda: server.refused["malformed"] == 1)
            assert "hello" in receive(page)
    assert sum("message failed: ZError" in text for text in said) == 1
    assert sum("OrderDesk.poll failed: ZError" in text for text in said) == 1
    assert capfd.readouterr() == ("", "")


def test_ended_loops_restart_at_the_same_address(network: LocalNetwork) -> None:
    said: list[str] = []
    with PageServer(network.join(), SystemClock(), "s1", say=said.append) as server:
        address = server.address
        loop = server._loop
        assert loop is not None
        with open_socket(server) as page:
            receive(page)
            loop.call_soon_threadsafe(loop.stop)
            until(lambda: len(said) > 1 and server._loop is not loop)
        until(lambda: is_reached(server))
        assert server.address == address
        with open_socket(server) as page:
            assert "hello" in receive(page)
    assert server.refused["server failed: RuntimeError"] == 1


def is_reached(server: PageServer) -> bool:
    """Returns True if the server answers."""
    with contextlib.suppress(OSError):
        return get(server, "/")[0] == 200
    return False


ORDERS = [
    '{"do":"link","link":"m1->s","to":{"delay_ms":1}}',
    '{"do":"shares","site":"s","to":{"m1":1.0}}',
    '{"do":"mark","text":"a"}',
    '{"do":"control","want":true}',
    '{"do":"answer","page":1,"yes":true}',
    '{"do":"ages","shown":false}',
    '{"do":"end"}',
    '{"do":"release","order":"enable","sites":["s"]}',
    '{"do":"release","order":"reset","sites":["s"]}',
    '{"do":"hand","site":"m2","grip":true,"to":[1.0,0.5]}',
]
"""Orders that neither a user of m1 nor a watcher may give."""
OWN_HAND = '{"do":"hand","site":"m1","grip":true,"to":[1.0,0.5]}'


def read_links(server: PageServer, said: list[str]) -> dict[str, str]:
    """Returns the links that a server prints, by role and user."""
    server.view.scenario = load_scenario("paper")
    until(lambda: len(said) == 4)
    return dict(line.split(": ", 1) for line in said)


@pytest.fixture(
    params=[PageOptions(), PageOptions(host="0.0.0.0", insecure=True)], ids=["open", "tokens"]
)
def roles(
    network: LocalNetwork, request: pytest.FixtureRequest
) -> Iterator[tuple[PageServer, dict[str, str]]]:
    said: list[str] = []
    options: PageOptions = request.param
    with PageServer(
        network.join(), SystemClock(), "s1", options, ends=True, say=said.append
    ) as page_server:
        yield page_server, read_links(page_server, said)


def test_each_role_has_a_link_naming_it(
    roles: tuple[PageServer, dict[str, str]],
) -> None:
    """The page at a link has the link's role and site, and only the experimenter ends sessions."""
    server, links = roles
    assert list(links) == ["experimenter", "user m1", "user m2", "watcher"]
    views = {}
    for name, link in links.items():
        with open_socket(server, link=link) as page:
            hello = receive(page)["hello"]
            assert isinstance(hello, dict)
            views[name] = hello["role"], hello["as"], hello["ends"]
    assert views == {
        "user m1": ("user", "m1", False),
        "user m2": ("user", "m2", False),
        "watcher": ("watcher", "", False),
        "experimenter": ("experimenter", "", True),
    }


@pytest.mark.parametrize("name", ["user m1", "watcher"])
def test_users_and_watchers_give_no_orders_but_stop(
    roles: tuple[PageServer, dict[str, str]], name: str, network: LocalNetwork
) -> None:
    """A user's or watcher's page may stop all arms, and its other orders are counted as refused."""
    server, links = roles
    stops = network.join().query_inbox("trilat/s1/s/stop")
    changes = network.join().query_inbox("trilat/s1/s/set")
    with open_socket(server, link=links[name]) as page:
        server.view.sites = {"s": None}  # type: ignore[dict-item]
        server.view.links = {"m1->s": {}}  # type: ignore[dict-item]
        for order in ORDERS:
            page.send(order)
        until(lambda: server.refused["not of its role"] == len(ORDERS))
        page.send(OWN_HAND)  # a user may move its hand, but the session has no m1
        counted = Counter({"not of its role": len(ORDERS)})
        counted["nobody can hold it" if name == "user m1" else "not of its role"] += 1
        until(lambda: server.refused >= counted)
        assert {reason: server.refused[reason] for reason in counted} == counted
        page.send('{"do":"stop"}')
        query = until(stops.poll)
        source = "the user of m1" if name == "user m1" else "a watcher"
        assert decode(query.payload, ChangeRequest) == ChangeRequest(
            order="stop", source=source
        )
    assert changes.poll() is None
    assert not server.end_requested.is_set()


def test_a_users_token_opens_only_its_view() -> None:
    said: list[str] = []
    guarded = PageOptions(host="0.0.0.0", insecure=True)
    with PageServer(
        LocalNetwork().join(), SystemClock(), "s1", guarded, say=said.append
    ) as server:
        links = read_links(server, said)
        token = urlsplit(links["user m1"]).fragment
        for query in ("", "?as=m2", "?as=s", "?as=", "?watch", "?watch&as=m2"):
            with pytest.raises(InvalidStatus, match="403"):
                open_socket(server, link=f"{links['user m1'].partition('?')[0]}{query}#{token}")
        watching = urlsplit(links["watcher"]).fragment
        with open_socket(
            server, link=f"{links['watcher'].partition('?')[0]}#{watching}"
        ) as page:
            assert '"role":"watcher"' in str(page.recv(timeout=5))  # without the word too
    assert server.refused["no token"] == 6


def test_users_take_part_beside_experimenters(network: LocalNetwork) -> None:
    """A user's page and an experimenter's page both take part without a request."""
    with PageServer(network.join(), SystemClock(), "s1") as server:
        with (
            open_socket(server, link=with_query(server.address, "as=m1")) as user,
            open_socket(server) as experimenter,
        ):
            receive(user)
            receive(experimenter)
            until(lambda: len(server._pages) == 2)
            takes_part = {page.role.kind: page.takes_part for page in server._pages}
        assert takes_part == {"user": True, "experimenter": True}


def test_pages_of_unknown_sites_are_closed(server: PageServer) -> None:
    server.view.scenario = load_scenario("paper")
    with (
        open_socket(server, link=with_query(server.address, "as=m9")) as page,
        pytest.raises(ConnectionClosed) as closed,
    ):
        receive(page)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.reason == "the session has no such site"


def test_report_and_log_are_the_experimenters_only(
    server: PageServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the experimenter's page gets the address of the report, whose scripts reach nothing."""
    monkeypatch.setattr(server._frames, "make_frame", lambda: {"sites": {}, "t": 0.0})
    monkeypatch.setattr(server._frames, "describe_as", lambda *_, **__: {"t": 0.0})
    report = tmp_path / "report.html"
    report.write_text("<p>a report</p>")
    server.files.results = {"/secret/report.html": report}
    results = {}
    for link in ("", "as=m1", "watch", "watch&as=m1"):
        with open_socket(server, link=with_query(server.address, link)) as page:
            while "results" not in (message := receive(page)):
                page.send(json.dumps({"do": "seen", "n": 2**40}))
            results[link] = message["results"]
    assert results == {"": ["/secret/report.html"], "as=m1": [], "watch": [], "watch&as=m1": []}
    status, policy, content = get(server, "/secret/report.html")
    assert (status, content) == (200, b"<p>a report</p>")
    assert "sandbox" in policy
    assert "default-src 'none'" in policy
    assert get(server, "/report.html")[0] == get(server, "/secret/")[0] == 404


def test_watchers_take_no_other_places(network: LocalNetwork) -> None:
    """Watchers who fill all their places exclude no experimenter and no user."""
    said: list[str] = []
    with (
        PageServer(network.join(), SystemClock(), "s1", say=said.append) as server,
        ExitStack() as stack,
    ):
        links = read_links(server, said)
        for _ in range(MAX_PAGES["watcher"]):
            receive(stack.enter_context(open_socket(server, link=links["watcher"])))
        for _ in range(3):
            with pytest.raises(InvalidStatus, match="503"):
                open_socket(server, link=links["watcher"])
        assert server.refused["too many watchers"] == 3
        for name in ("experimenter", "user m1", "user m2"):
            assert "hello" in receive(
                stack.enter_context(open_socket(server, link=links[name]))
            )


@pytest.mark.parametrize("name", ["experimenter", "user m1"])
def test_newest_page_of_experimenter_or_user_gets_in(name: str, network: LocalNetwork) -> None:
    """The oldest page of a role gives way to a new one, but not the experimenter who takes part."""
    said: list[str] = []
    with (
        PageServer(network.join(), SystemClock(), "s1", say=said.append) as server,
        ExitStack() as stack,
    ):
        links = read_links(server, said)
        kind = name.split()[0]
        pages = []
        for _ in range(MAX_PAGES[kind] + 1):
            pages.append(stack.enter_context(open_socket(server, link=links[name])))
            assert "hello" in receive(pages[-1])
        other = stack.enter_context(open_socket(server, link=links["user m2"]))
        assert "hello" in receive(other)
        # the first experimenter takes part
        oldest = pages[1] if kind == "experimenter" else pages[0]
        with pytest.raises(ConnectionClosed) as closed:
            until(lambda: receive(oldest) and False)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.reason == "a newer page took its place"
        until(lambda: len(server._pages) == MAX_PAGES[kind] + 1)
        assert server.refused[f"too many pages of {kind}s"] == 1


@pytest.mark.parametrize(
    "sent", [b"", b"GET / HT", b"GET /three.module.min.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"]
)
def test_silent_and_slow_connections_exclude_nobody(sent: bytes, server: PageServer) -> None:
    """Connections that send nothing, half of a request, or never read their answer exclude no page."""
    address = urlsplit(server.address)
    with ExitStack() as stack:
        for _ in range(3 * MAX_STRANGERS):
            slow = stack.enter_context(create_connection((address.hostname, address.port), 5))
            slow.sendall(sent)
        with open_socket(server) as page:
            assert "hello" in receive(page)
        assert get(server, "/")[0] == 200
    if len(sent) < 10:  # the others were answered, and closed
        assert server.refused["too many connections"] >= 2 * MAX_STRANGERS - 10


def test_silent_connections_are_closed(server: PageServer) -> None:
    address = urlsplit(server.address)
    with create_connection((address.hostname, address.port), 20 * REQUEST_TIMEOUT_S) as silent:
        silent.sendall(b"GET / HT")
        assert silent.recv(100) == b""


def test_silent_connections_to_encrypted_page_are_closed(
    network: LocalNetwork, tmp_path: Path
) -> None:
    (keys,) = create_keys(tmp_path / "keys", ["operator"])
    with PageServer(network.join(), SystemClock(), "s1", PageOptions(tls=keys)) as server:
        address = urlsplit(server.address)
        with create_connection(
            (address.hostname, address.port), 20 * REQUEST_TIMEOUT_S
        ) as silent:
            assert silent.recv(100) == b""


def test_browsers_are_opened_by_the_users_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The browser opens a private file with the link, so that no command line has the token."""
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    opening = BrowserOpening("http://127.0.0.1:1/?as=m1&x=<b>#token=secret")
    opening.open()
    (folder,) = tmp_path.iterdir()
    file = folder / "open.html"
    assert opened == [file.as_uri()]
    assert "secret" not in opened[0]
    assert 'href="http://127.0.0.1:1/?as=m1&amp;x=&lt;b&gt;#token=secret"' in file.read_text()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert file.stat().st_mode & 0o777 == 0o600
    opening.remove_file()
    assert not list(tmp_path.iterdir())
