"""Sessions through a router, and over TLS by a configuration of one's own."""

import signal

import pytest

from tests.net.certificates import Certificates
from trilat_net.execution.verify import verify
from trilat_net.log.log_reader import open_log
from trilat_net.net.connection import find_free_endpoints

from .processes import BEGUN, Process, Stage, equal_to_virtual_time, executed_again, recorded, whole

SITES = ("m", "s")


class Routed:
    """The processes of a session of two sites that go through a router."""

    def __init__(self, stage: Stage, duration: str, protocol: str = "tcp", *options: str) -> None:
        self._stage, self._duration, self._options = stage, duration, options
        (endpoint,) = find_free_endpoints(1)
        self.endpoint = endpoint.replace("tcp", protocol)
        self.log = stage.folder / "run.mcap"
        self.members: dict[str, Process] = {}

    def router(self, called: str = "router") -> Process:
        return self._stage.start(called, "router", "--listen", self.endpoint, *self._options)

    def start(self, *names: str) -> None:
        through = ("--session", "t", "--router", self.endpoint, *self._options)
        for name in names:
            words = (
                "site",
                name,
                "--scenario",
                "two_sites",
                "--duration",
                self._duration,
                "--needs-recorder",
            )
            if name == "recorder":
                words = ("record", "-o", str(self.log))
            self.members[name] = self._stage.start(name, *words, *through)

    def codes(self) -> dict[str, int]:
        return {name: process.code() for name, process in self.members.items()}


@pytest.mark.long
def test_a_session_over_tls_that_both_sides_prove_themselves_in(stage: Stage) -> None:
    made = Certificates(stage.folder)
    own = stage.folder / "zenoh.json5"
    own.write_text(
        f"""{{ transport: {{ link: {{ tls: {{
            root_ca_certificate: "{made.authority}", enable_mtls: true,
            listen_certificate: "{made.certificate}", listen_private_key: "{made.key}",
            connect_certificate: "{made.certificate}", connect_private_key: "{made.key}",
        }} }} }} }}"""
    )
    session = Routed(stage, "1", "tls", "--zenoh-config", str(own))
    router = session.router()
    session.start("recorder", *SITES)
    assert session.codes() == {"recorder": 0, "m": 0, "s": 0}
    log = whole(session.log)
    executed_again(log)
    equal_to_virtual_time(log)
    router.signal(signal.SIGTERM)
    assert router.code() == 128 + signal.SIGTERM


def test_a_router_that_is_killed_and_started_again_heals_the_session(stage: Stage) -> None:
    """The loops never stop; what was made meanwhile comes into the log from the sites' memory."""
    session = Routed(stage, "8")
    router = session.router()
    session.start("recorder", *SITES)
    for process in session.members.values():
        process.prints(BEGUN)
    recorded(session.log)  # the run is on its way: before tick 0 nothing would be missing
    router.signal(signal.SIGKILL)
    assert router.code() == -signal.SIGKILL
    again = session.router("router again")
    for name in session.members:
        again.prints(f"router: session t: {name} is here")
    assert session.codes() == {"recorder": 0, "m": 0, "s": 0}
    again.signal(signal.SIGINT)
    assert again.code() == 130
    for name in SITES:
        assert "8000 ticks" in session.members[name].text()
    log = open_log(session.log)
    assert log.complete
    assert all("missing 0," in log.account(name) for name in SITES)
    assert verify(log).passed
    for name, peer in (SITES, SITES[::-1]):
        used = [state.used[peer] for state in log[name].states]
        assert used == sorted(used)
        # of a link of 200 ms, on a machine that may be busy
        assert log[name].states[-1].tick - used[-1] <= 1000
        assert {event.kind for event in log.events if event.member == name} >= {"end"}
