"""Users' own routers and Zenoh configurations, as options: bad input gives one line and exit code 2."""

from pathlib import Path

import pytest

from trilat_net.net.connection import find_free_endpoints
from trilat_net.net.zenoh_bus import ZenohBus

from .running import trilat

COMMANDS = [("site", "m", "--scenario", "two_sites"), ("record", "--session", "t"), ("router",)]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
def test_a_bad_configuration_is_refused_in_one_line(
    command: tuple[str, ...], tmp_path: Path
) -> None:
    trilat(*command, "--zenoh-config", "none.json5", cwd=tmp_path).refuses(
        "none.json5", "No such file"
    )
    (tmp_path / "mine.json5").write_text(
        "{transport: {link: {tls: {root_ca_certificate: 'none.pem'}}}}"
    )
    done = trilat(*command, "--zenoh-config", "mine.json5", cwd=tmp_path)
    done.refuses("mine.json5: transport/link/tls/root_ca_certificate: none.pem cannot be read")
    assert done.out == ""


@pytest.mark.parametrize("command", COMMANDS[:2], ids=lambda command: command[0])
def test_a_router_runs_alone(command: tuple[str, ...], tmp_path: Path) -> None:
    options = ("--router", "tcp/127.0.0.1:1", "--connect", "tcp/127.0.0.1:2")
    trilat(*command, *options, cwd=tmp_path).refuses("--router: ", "leave out --connect")


def test_a_router_that_does_not_answer_is_named(tmp_path: Path) -> None:
    (endpoint,) = find_free_endpoints(1)
    done = trilat(*COMMANDS[1], "--router", endpoint, "--join-timeout", "0", cwd=tmp_path)
    done.refuses(f"no router answers at {endpoint} within 0 s")
    assert not (tmp_path / "t.mcap").exists()


def test_a_router_on_a_busy_port_says_so(tmp_path: Path) -> None:
    (endpoint,) = find_free_endpoints(1)
    other = ZenohBus([endpoint])
    try:
        trilat("router", "--listen", endpoint, cwd=tmp_path).refuses(
            f"{endpoint}: the port is in use"
        )
    finally:
        other.close()


@pytest.mark.parametrize("seconds", ["-1", "nan", "inf"])
def test_an_invalid_time_is_refused_by_name(seconds: str, tmp_path: Path) -> None:
    trilat("router", "--until-idle", seconds, cwd=tmp_path).refuses(
        "--until-idle must be a number of seconds"
    )
