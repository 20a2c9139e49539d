"""Users' own routers as options: no router, and a port in use."""

from pathlib import Path

from tests.net.free_endpoints import find_free_endpoints
from trilat_net.net.zenoh_bus import ZenohBus

from .running import trilat


def test_a_router_that_does_not_answer_is_named(tmp_path: Path) -> None:
    (endpoint,) = find_free_endpoints(1)
    record = ("record", "--session", "t", "--router", endpoint, "--join-timeout", "0")
    done = trilat(*record, cwd=tmp_path)
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
