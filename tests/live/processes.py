"""Real processes of a session, started, watched and ended by a test, and what their log says."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tests.cli.running import COMMAND, PLAIN
from tests.faults.invariants import SILENT_TICKS, count_silence, split_stretches
from tests.net.free_endpoints import find_free_endpoints
from tests.net.waiting import sleep_for_ns, until
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_layout import active_path
from trilat_net.log.log_reader import Log, open_log
from trilat_net.net.clock import SystemClock
from trilat_net.own_code.code_consent import allow_own_code

PAPER = ("m1", "m2", "s")
BEGUN = "the session begins"
PATIENCE_S = 60.0
TALKING = ("--set", "control.law=tests.channel_law:Talking")
"""Options of a session whose laws send to all and to each."""
GLIDE = (
    "--set",
    'on_stale.action="glide"',
    "--set",
    "on_stale.align_speed_rad_s=1.0",
    "--set",
    "on_stale.align_limit_rad=3.0",
)
OUTSIDE = [
    word
    for key, value in {
        "plant": "external",
        "arm.known": "false",
        "on_stale.action": "glide",
        "on_stale.align_limit_rad": "4",
        "limits.tau_limit_nm": "150",
        "limits.tau_rate_limit_nm_s": "5000",
        "limits.qd_des_limit_rad_s": "5",
        "limits.q_min_rad": "-6.3",
        "limits.q_max_rad": "6.3",
    }.items()
    for word in ("--set", f"sites.s.{key}={value}")
]
"""Options of a session whose site s has an arm outside of the program."""
JOINS = "joins the running session"
FOLLOWS = " s, run, "
HOLDER = """
import sys, time, trilat_net
with trilat_net.hand("t", sys.argv[1], connect=sys.argv[2:], source="to be killed", timeout_s=60.0) as hand:
    start = hand.pose
    while True:
        hand.move(start[0] + 0.05, start[1] + 0.05)
        if hand.holds:
            print("holds", flush=True)
        time.sleep(0.01)
"""


class Process:
    """One process, with what it prints in a file; `before` are words before its command."""

    def __init__(
        self, name: str, arguments: Sequence[str], folder: Path, before: Sequence[str] = ()
    ) -> None:
        self.name = name
        self.folder = folder
        self._printed = folder / f"{name}.printed"
        with self._printed.open("wb") as sink:
            self._process = subprocess.Popen(
                [*before, *COMMAND, *arguments],
                cwd=folder,
                env=PLAIN,
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self.pid = self._process.pid

    def text(self) -> str:
        return self._printed.read_text(encoding="utf-8", errors="replace")

    def prints(self, sentence: str) -> None:
        until(lambda: sentence in self.text() or self.ended(), PATIENCE_S)
        assert sentence in self.text(), self

    def ended(self) -> bool:
        return self._process.poll() is not None

    def signal(self, number: int) -> None:
        if not self.ended():
            self._process.send_signal(number)

    def code(self, timeout_s: float = PATIENCE_S) -> int:
        until(self.ended, timeout_s)
        assert "Traceback" not in self.text(), self
        return int(self._process.returncode)

    def children(self) -> dict[int, str]:
        """Returns all processes below this one: the starter of a session and its members."""
        return dict(list_descendants(self.pid))

    def end(self) -> None:
        for number in (signal.SIGCONT, signal.SIGINT, signal.SIGKILL):
            self.signal(number)
            with contextlib.suppress(AssertionError):
                until(self.ended, 0.0 if number == signal.SIGCONT else 20.0)
                return

    def __repr__(self) -> str:
        return f"{self.name}: exit code {self._process.poll()}, printed\n{self.text()}"


def list_descendants(pid: int) -> Iterator[tuple[int, str]]:
    """Returns the commands of all processes of this program below a process, by process id."""
    with contextlib.suppress(OSError):
        for child in map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()):
            line = Path(f"/proc/{child}/cmdline").read_bytes().replace(b"\0", b" ").decode()
            if "trilat" in line:
                yield child, line
            yield from list_descendants(child)


def is_running(pid: int) -> bool:
    """Returns True if a process runs; unlike for `is_gone`, an ended process need not be waited for."""
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


def is_gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


class Stage:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._started: list[Process] = []

    def start(self, name: str, *arguments: str, before: Sequence[str] = ()) -> Process:
        process = Process(name, arguments, self.folder, before)
        self._started.append(process)
        return process

    def clear(self) -> None:
        for process in self._started:
            process.end()


class Session:
    """The processes of one session on explicit endpoints.

    Args:
        stage: where they run.
        scenario: a shipped one.
        sites: its sites.
        options: what every site is given besides, as in `--set KEY=VALUE`.
    """

    def __init__(
        self, stage: Stage, scenario: str, sites: Sequence[str], *options: str
    ) -> None:
        self.stage = stage
        self._scenario = scenario
        self._options = options
        self.sites = tuple(sites)
        *self.endpoints, self.recorder_endpoint = find_free_endpoints(len(sites) + 1)
        self.log = stage.folder / "run.mcap"
        self.processes: dict[str, Process] = {}
        self.before: dict[str, Sequence[str]] = {}  # words before the command of a member

    def ways(self, name: str) -> list[str]:
        """Returns the options by which a member listens, and connects to the members before it."""
        place = self.sites.index(name) if name in self.sites else len(self.sites)
        endpoint = [*self.endpoints, self.recorder_endpoint][place]
        return ["--listen", endpoint, *connection_options(self.endpoints[:place])]

    def site(self, name: str, *more: str, called: str = "") -> Process:
        arguments = ("site", name, "--scenario", self._scenario, *self._options)
        return self._start(name, arguments, more, called or name)

    def recorder(
        self, *more: str, called: str = "recorder", log: Path | None = None
    ) -> Process:
        return self._start("recorder", ("record", "-o", str(log or self.log)), more, called)

    def _start(
        self, name: str, arguments: Sequence[str], more: Sequence[str], called: str
    ) -> Process:
        arguments = (*arguments, "--session", "t", *self.ways(name), *more)
        self.processes[called] = self.stage.start(
            called, *arguments, before=self.before.get(name, ())
        )
        return self.processes[called]

    def all(self, *order: str) -> None:
        for name in order or ("recorder", *self.sites):
            if name == "recorder":
                self.recorder()
            else:
                self.site(name, "--needs-recorder")

    def ends_well(self) -> None:
        assert self.codes() == dict.fromkeys(self.processes, 0)

    def is_reproduced(self) -> Log:
        self.ends_well()
        log = open_whole_log(self.log)
        assert_executed_again(log)
        assert_equals_virtual_time(log)
        return log

    def begun(self) -> None:
        for process in self.processes.values():
            process.prints(BEGUN)

    def recording(self) -> None:
        wait_for_records(self.log)

    def codes(self) -> dict[str, int]:
        return {name: process.code() for name, process in self.processes.items()}


def wait_for_records(log: Path) -> None:
    until(lambda: measure_log_size(log) > 60_000, PATIENCE_S)  # its head is a third of that


def measure_log_size(log: Path) -> int:
    for path in (active_path(log), log):
        with contextlib.suppress(FileNotFoundError):
            return path.stat().st_size
    return 0


def connection_options(endpoints: Sequence[str]) -> list[str]:
    return [word for endpoint in endpoints for word in ("--connect", endpoint)]


def open_whole_log(*paths: Path, in_full: bool = True) -> Log:
    log = open_log(*paths)
    assert log.complete
    for name in log.sites:
        (tick_count,) = (
            event.ticks for event in log.events if (event.member, event.kind) == (name, "end")
        )
        ticks = [state.tick for state in log[name].states]
        assert ticks[-1] == tick_count - 1
        # a site at an arm outside leaves out what it misses
        if name not in log.scenario.external:
            assert ticks == list(range(tick_count))
        assert len(ticks) == len(set(ticks)) == tick_count - log[name].skipped
        assert not in_full or tick_count == log.scenario.ticks(name)
    assert all("missing 0, duplicate 0" in log.account(name) for name in log.sites)
    return log


def allow_own_laws(log: Log) -> Log:
    """Returns a log whose laws may run, because the test recorded the log."""
    allow_own_code(log.scenario)
    return log


def assert_executed_again(log: Log) -> None:
    """Asserts that every record follows from its inputs."""
    verdict = verify_log(allow_own_laws(log))
    assert verdict.whole_run
    assert verdict.first is None
    assert verdict.identical == verdict.records == sum(len(log[name]) for name in log.sites)


def assert_equals_virtual_time(log: Log) -> None:
    """Asserts that a log equals virtual time: with its arrivals always, plainly until a sample was late or lost."""
    twins = compare_with_virtual(allow_own_laws(log))
    records = sum(len(log[name]) for name in log.sites)
    assert twins.fed.first is None
    assert twins.fed.identical == twins.fed.records == records
    if twins.excused_from is None:
        assert twins.plain.first is None
        assert twins.plain.identical == twins.plain.records == records
    else:
        assert twins.plain.first is None or twins.plain.first.tick >= twins.excused_from


def pause(time_s: float) -> None:
    clock = SystemClock()
    sleep_for_ns(clock, round(time_s * 1e9))


def ticks_to_hold(log: Log) -> dict[str, list[int]]:
    """Returns the number of ticks from the last sample in use to each hold, by site."""
    holds_by_site: dict[str, list[int]] = {site: [] for site in log.sites}
    for site, holds in holds_by_site.items():
        for stretch in split_stretches(log[site].states):
            before = ""
            for state, silent in count_silence(stretch):
                assert state.mode not in ("run", "return") or silent <= SILENT_TICKS, (
                    site,
                    state.tick,
                )
                if state.mode == "hold" != before:
                    holds.append(silent)
                before = state.mode
    return holds_by_site


def list_engagements_s(log: Log) -> list[float]:
    """Returns the time in s from the first tick of each later start until the site followed its peers."""
    delays_s = []
    for site, starts in log.starts.items():
        part = log[site]
        for first, _ in starts:
            engaged = (part.tick >= first) & (part.mode == "run")
            assert engaged.any(), (site, first)
            delays_s.append(float(part.tick[np.argmax(engaged)] - first) / part.rate_hz)
    return delays_s


class Holder:
    """A process that holds m1 until it is killed."""

    def __init__(self, session: Session, folder: Path, before: Sequence[str] = ()) -> None:
        command = [*before, sys.executable, "-c", HOLDER, "m1", *session.endpoints]
        self._printed = folder / "holder.txt"
        root = Path(__file__).parents[2]
        with self._printed.open("wb") as sink:
            self._process = subprocess.Popen(command, stdout=sink, env=PLAIN, cwd=root)

    def holds(self) -> bool:
        return b"holds" in self._printed.read_bytes()

    def end(self) -> None:
        self._process.kill()
        self._process.wait()


GONE_S = 0.320
"""The longest time from the last message of a hand to the end of its force."""


def assert_let_go(log: Log, who: str = "to be killed") -> None:
    """Asserts that the force on m1 ends soon after the last message of a hand, and that the log has the reason."""
    part = log["m1"]
    number = part.hand[:, 1]
    grip = part.hand[:, 0]
    newest = int(np.flatnonzero(np.diff(number) > 0)[-1]) + 1
    last = int(np.flatnonzero(grip > 0.0)[-1])
    assert np.abs(part.tau_x[newest : last + 1]).max() > 1.0
    assert not part.tau_x[last + 1 :].any()
    assert part.t_s[last + 1] - part.t_s[newest] <= GONE_S
    texts = [event.text for event in log.events if event.kind == "hand"]
    assert [text.partition(" at t")[0] for text in texts][-2:] == [
        f"m1: {who} takes hold",
        f"m1: {who} is silent: let go",
    ]
