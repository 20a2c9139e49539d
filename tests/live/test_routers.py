"""Sessions through a router, with keys, and over TLS by a configuration of one's own."""

import signal

import pytest

from tests.live.processes import assert_executed_again, connection_options
from tests.net.certificates import Certificates
from trilat_net.execution.log_checks import LogCheckReport
from trilat_net.log.log_reader import open_log
from trilat_net.net.member_keys import create_keys
from trilat_net.net.zenoh_config import OPERATOR, RECORDER, ROUTER

from .processes import Process, Session, Stage

SITES = ("m", "s")


class Routed(Session):
    def __init__(
        self, stage: Stage, duration: str, protocol: str = "tcp", *network: str
    ) -> None:
        super().__init__(stage, "two_sites", SITES, "--duration", duration)
        self.endpoint = self.recorder_endpoint.replace("tcp", protocol)
        self._network = network

    def network(self, name: str) -> list[str]:  # noqa: ARG002 - all of them alike
        """How a member is secured."""
        return [*self._network]

    def ways(self, name: str) -> list[str]:
        return ["--router", self.endpoint, *self.network(name)]

    def router(self, called: str = "router") -> Process:
        return self.stage.start(
            called, "router", "--listen", self.endpoint, *self.network("router")
        )


class Keyed(Routed):
    def __init__(self, stage: Stage, duration: str) -> None:
        super().__init__(stage, duration, "tls")
        create_keys(stage.folder / "keys", [*SITES, RECORDER, ROUTER], [], 1)

    def network(self, name: str) -> list[str]:
        return ["--keys", str(self.stage.folder / "keys" / name)]


@pytest.mark.long
def test_sessions_run_over_mutual_tls(stage: Stage) -> None:
    own = Certificates(stage.folder).zenoh_file()
    session = Routed(stage, "1", "tls", "--zenoh-config", str(own))
    router = session.router()
    session.all()
    session.is_reproduced()
    router.signal(signal.SIGTERM)
    assert router.code() == 128 + signal.SIGTERM


@pytest.mark.long
def test_sessions_heal_when_killed_routers_return(stage: Stage) -> None:
    """The loops never stop; what was made meanwhile comes into the log from the sites' memory."""
    session = Keyed(stage, "8")
    router = session.router()
    session.all()
    session.begun()
    session.recording()  # the run is on its way: before tick 0 nothing would be missing
    router.signal(signal.SIGKILL)
    assert router.code() == -signal.SIGKILL
    again = session.router("router again")
    for name in session.processes:
        again.prints(f"router: session t: {name} is here")
    session.ends_well()
    again.signal(signal.SIGINT)
    assert again.code() == 130
    for name in SITES:
        assert "8000 ticks" in session.processes[name].text()
    log = open_log(session.log)
    assert log.complete
    assert all("missing 0," in log.account(name) for name in SITES)
    report = LogCheckReport.of_log(log, virtual=True)
    assert report.passed, report.findings  # samples were lost on the way, and the log shows it
    for name, peer in (SITES, SITES[::-1]):
        used = [state.used[peer] for state in log[name].states]
        assert used == sorted(used)
        # of a link of 200 ms, on a machine that may be busy
        assert log[name].states[-1].tick - used[-1] <= 1000
        assert {event.kind for event in log.events if event.member == name} >= {"end"}


@pytest.mark.long
def test_all_may_stop_but_only_operators_enable(stage: Stage) -> None:
    glide = ("--set", "on_stale.action=glide", "--set", "on_stale.align_limit_rad=3")
    # an operator ends it long before that
    session = Session(stage, "two_sites", SITES, "--duration", "600", *glide)
    create_keys(stage.folder / "keys", [*SITES, RECORDER, OPERATOR], [], 1)
    session.endpoints = [place.replace("tcp", "tls") for place in session.endpoints]
    session.recorder_endpoint = session.recorder_endpoint.replace("tcp", "tls")

    def keys(name: str) -> tuple[str, str]:
        return "--keys", str(stage.folder / "keys" / name)

    def order(words: str, whose: str) -> tuple[int, str]:
        ways = connection_options(session.endpoints)
        asked = stage.start(
            f"{words} by {whose}", *words.split(), "--session", "t", *ways, *keys(whose)
        )
        return asked.code(), asked.text()

    session.recorder(*keys(RECORDER))
    for name in SITES:
        session.site(name, "--needs-recorder", *keys(name))
    session.begun()
    for whose in (RECORDER, "m"):
        code, text = order("stop s", whose)
        trying, answer = text.splitlines()
        assert (code, trying) == (0, "stopping every arm of session t ..."), text
        assert answer.startswith("s executes stop at tick")
        code, text = order("enable s", whose)
        assert code != 0
        assert f"these are the keys of {whose}; the keys of operator are needed" in text
        code, text = order("enable s", OPERATOR)
        assert code == 0, text
    assert order("stop --end", "m")[0] != 0
    assert order("stop --end", OPERATOR)[0] == 0
    session.ends_well()
    log = open_log(session.log)
    assert_executed_again(log)
    changes = [change for state in log["s"].states for change in state.cmd]
    assert [change.rpartition(":")[2] for change in changes] == ['"stop"}', '"enable"}'] * 2


class Joined(Keyed):
    """Every computer has a router of its own, as on docs/sessions/two-operators.md; all of them know the public one."""

    def __init__(self, stage: Stage, duration: str) -> None:
        super().__init__(stage, duration)
        self.local = {
            name: place.replace("tcp", "tls")
            for name, place in zip(SITES, self.endpoints, strict=True)
        }

    def ways(self, name: str) -> list[str]:
        """The recorder runs beside the slave."""
        return ["--router", self.local.get(name, self.local["s"]), *self.network(name)]

    def routers(self) -> None:
        _ = self.router("public")
        for name, place in self.local.items():
            words = ("--listen", place, "--connect", self.endpoint, *self.network(ROUTER))
            self.stage.start(f"router of {name}", "router", *words)


@pytest.mark.long
def test_members_behind_routers_of_their_own_meet(stage: Stage) -> None:
    session = Joined(stage, "2")
    session.routers()
    session.all()
    session.is_reproduced()
