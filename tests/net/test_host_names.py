"""Host names that do not resolve: every command reports the name at once."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.net.manual_clock import ManualClock
from trilat_net.errors import UsageError
from trilat_net.net.connection import Connection
from trilat_net.net.host_names import UnknownHost, check_hosts

NO_NAME = "no..host"
"""A part of this name is empty, so that no resolver is asked."""
UNKNOWN = "tcp/nohost.invalid:7447"
"""Of a domain that never exists (RFC 6761)."""


@pytest.mark.parametrize(
    "place",
    [
        f"tcp/{NO_NAME}:7447",
        f"tls/{NO_NAME}:7447",
        f"quic/{NO_NAME}:7447?x=1#iface=eth0",
        f"tcp://{NO_NAME}:8786",
        f"ws://{NO_NAME}:10001/path",
        f"tcp/{'x' * 64}:1",
    ],
)
def test_unresolvable_names_are_refused(place: str) -> None:
    with pytest.raises(UnknownHost) as refused:
        check_hosts(["tcp/127.0.0.1:1", place])
    assert str(refused.value).startswith(f"{place}: the host name '")
    assert "does not resolve" in str(refused.value)


@pytest.mark.parametrize(
    "place",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tcp/[fe80::1%eth0]:7447",
        "tcp/localhost:7447",
        "tls/0.0.0.0:0",
        "unixsock-stream/tmp/socket",
        "serial//dev/ttyUSB0#baudrate=9600",
        "nonsense",
        "tcp/:7447",
    ],
)
def test_other_names_pass(place: str) -> None:
    check_hosts([place])


def test_members_with_unknown_names_never_wait() -> None:
    """Otherwise peers retry for ever, and clients report that no router answers yet.

    A group of locators counts too.
    """
    said: list[str] = []
    for connection in (
        Connection(connect=[f"tcp/{NO_NAME}:1"]),
        Connection(connect=[f"tcp/{NO_NAME}:1"], mode="client"),
        Connection(connect=[{"locators": ["tcp/127.0.0.1:1", f"tcp/{NO_NAME}:1"]}]),
        Connection(listen=[f"tcp/{NO_NAME}:1"]),
        Connection(connect=[f"tcp/{NO_NAME}:1"], keys_of="m"),
    ):
        with pytest.raises(UsageError, match=rf"{NO_NAME}:1: the host name"):
            connection.open_bus(ManualClock(), lambda: False, None, said.append)
    assert said == []


COMMANDS = [
    f"site m1 --scenario paper --connect {UNKNOWN}",
    f"site m1 --scenario paper --router {UNKNOWN}",
    f"record --session paper --connect {UNKNOWN}",
    f"record --session paper --router {UNKNOWN}",
    f"stop --session paper --connect {UNKNOWN}",
    f"enable --session paper --router {UNKNOWN}",
    f"reset m1 --session paper --connect {UNKNOWN}",
    f"ping --session paper --connect {UNKNOWN}",
    f"ping --connect {UNKNOWN}",
    f"live --session paper --connect {UNKNOWN} --no-browser",
    f"watch --session paper --connect {UNKNOWN}",
    f"hand m1 --session paper --connect {UNKNOWN} --device spacemouse",
    f"router --connect {UNKNOWN}",
    f"router --listen {UNKNOWN} --insecure",
    f"ros2 --session paper --connect {UNKNOWN}",
    f"ros2 --session paper --ros {UNKNOWN}",
    f"doctor --connect {UNKNOWN}",
]


@pytest.mark.long
@pytest.mark.parametrize("command", COMMANDS, ids=lambda text: text.partition(f" {UNKNOWN}")[0])
def test_every_command_names_its_unresolvable_host(command: str, tmp_path: Path) -> None:
    command_line = [sys.executable, "-m", "trilat_net", *command.split()]
    process = subprocess.run(
        command_line, cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert process.returncode in (1, 2)  # 1: the examination of `doctor` found a failure
    assert "nohost.invalid" in process.stdout + process.stderr
    assert "resol" in process.stdout + process.stderr
    assert "Traceback" not in process.stderr
