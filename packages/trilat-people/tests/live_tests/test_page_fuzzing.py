"""Whatever comes to the page of a session that runs: the server lives, counts it, and the log is verified."""

import json
import socket
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.live.browsers import page_address
from tests.live.page_client import PageClient, page_client
from tests.live.processes import PAPER, Process, Stage

LINKS = [f"{peer}->{site}" for peer in PAPER for site in PAPER if peer != site]
# surrogates too: JSON can write them
letters = st.text(st.characters(exclude_categories=()), max_size=12)
odd = st.sampled_from(
    ["", "?", "??", "#", "a#b", "$", "$*", "*", "**", "/", "a/b", "@", "m1", "recorder", "->"]
)
names = (
    letters
    | odd
    | st.builds("{}->{}".format, letters | odd, letters | odd | st.sampled_from(PAPER))
)
numbers = st.floats() | st.integers() | st.floats(0.0, 1.0)


def either(own: list[str]) -> st.SearchStrategy[str]:
    """A name of the session, or hardly ever one."""
    return names | st.sampled_from(own)


messages = st.one_of(
    st.fixed_dictionaries(
        {
            "do": st.just("shares"),
            "site": either([*PAPER]),
            "to": st.dictionaries(either([*PAPER]), numbers, max_size=3),
        }
    ),
    st.fixed_dictionaries(
        {
            "do": st.just("link"),
            "link": either(LINKS),
            "to": st.dictionaries(
                either(["delay_ms", "loss", "deviation_ms", "preset", "model"]),
                numbers | names,
                max_size=3,
            ),
        }
    ),
    st.fixed_dictionaries(
        {
            "do": st.just("hand"),
            "site": either([*PAPER]),
            "grip": st.booleans(),
            "to": st.lists(numbers, max_size=3),
        }
    ),
    st.fixed_dictionaries({"do": st.just("mark"), "text": names}),
    st.fixed_dictionaries(
        {"do": st.just("answer"), "page": st.integers(), "yes": st.booleans()}
    ),
    st.sampled_from([{"do": "stop"}, {"do": "control", "want": True}]),
    st.dictionaries(names, numbers | names, max_size=3),
)
lines = st.text(st.characters(codec="latin-1", exclude_characters="\r\n"), max_size=30)
targets = (
    st.sampled_from(["//[", "/", "/socket", "http://[::1", "*", "/?token=%ff", "/%2e%2e/x"])
    | lines
)
hosts = (
    st.sampled_from(["[", "localhost", "127.0.0.1:x", "[::1", "", "a@b", "evil.example"])
    | lines
)
heads = st.lists(
    st.tuples(st.sampled_from(["Host", "Origin", "Upgrade"]) | lines, hosts), max_size=4
)
requests = st.binary(max_size=60) | st.builds(
    lambda target, head: "".join(
        [
            f"GET {target} HTTP/1.1\r\n",
            *(f"{name}: {value}\r\n" for name, value in head),
            "\r\n",
        ]
    ).encode("latin-1"),
    targets,
    heads,
)


def exhaust(strategy: st.SearchStrategy[Any], count: int, act: Callable[[Any], None]) -> None:
    @settings(max_examples=count, deadline=None, database=None)
    @given(strategy)
    def each(example: object) -> None:
        act(example)

    each()


def is_foreign(message: dict[str, Any]) -> bool:
    """True of an order that names what the session has not."""
    kind = message.get("do")
    own = message.get("link") in LINKS if kind == "link" else message.get("site") in PAPER
    return kind not in ("shares", "link", "hand", "mark", "answer", "stop", "control") or (
        kind in ("shares", "link", "hand") and not own
    )


def answer_to(address: str, request: bytes) -> bytes:
    place = urlsplit(address)
    with socket.create_connection((place.hostname, place.port), 30.0) as there:
        there.sendall(request)
        if b"\r\n\r\n" not in request:
            there.shutdown(socket.SHUT_WR)
        try:
            return there.recv(64)
        except ConnectionResetError:  # it has closed before it had read all
            return b""


# its socket does, in a thread
@pytest.mark.filterwarnings("ignore:Do not use the .random. module")
@pytest.mark.parametrize(
    ("count", "raw"),
    [(60, 12), pytest.param(3000, 300, marks=pytest.mark.long)],
    ids=["light", "whole"],
)
def test_no_page_message_ends_the_server(count: int, raw: int, stage: Stage) -> None:
    rare = ("--set", "rate_hz=100")  # records are few, messages are not
    words = (
        "live",
        "play",
        "--no-browser",
        "--duration",
        "600",
        "--out",
        str(stage.folder / "out"),
        *rare,
    )
    running: Process = stage.start("live", *words)
    address = page_address(running)
    with page_client(address) as page:
        page.shows("run")
        foreign = send_all(page, count)
        refused = page.take()["refused"]
        assert refused >= foreign > count // 10
        seen = 0

        def ask(request: bytes) -> None:
            nonlocal seen
            answer = answer_to(address, request)
            assert answer == b"" or answer[:12] in ANSWERS, (request, answer)
            seen += answer[9:12] in (b"400", b"403", b"426", b"414", b"431")
            page.take()

        exhaust(requests, raw, ask)
        while page.take()["refused"] < refused + seen:
            pass
        assert "Traceback" not in running.text(), running
        assert "failed" not in running.text(), running
        page.send(do="control", want=True)
        page.send(do="end")
        running.prints("checking the log")
    assert running.code(600.0) == 0, running
    assert "the page refused" in running.text()
    assert "executed again" in running.text()


ANSWERS = [
    b"HTTP/1.1 " + code for code in (b"200", b"400", b"403", b"404", b"414", b"426", b"431")
]


def send_all(page: PageClient, count: int) -> int:
    foreign = sent = 0

    def send(message: dict[str, Any]) -> None:
        nonlocal foreign, sent
        page.socket.send(json.dumps(message))
        foreign += is_foreign(message)
        sent += 1
        if sent % 5 == 0:
            page.take()

    exhaust(messages, count, send)
    return foreign
