"""Machines that are none: network namespaces with addresses of their own, joined by virtual cables.

Law: nothing stays. Every namespace of a test has a name of its own and is removed at the end, whatever
happens; the machine's own network is not touched.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import combinations, count
from typing import Self

from tests.live.processes import connection_options

from .processes import FOLLOWS, GLIDE, PAPER, Session, Stage

_numbers = count()
ALL = (*PAPER, "recorder")
PORT = "tcp/0.0.0.0:7447"
CLOCKS = {"m1": (0.0, 0.0), "m2": (3.0, 100.0), "s": (-2.0, -100.0), "recorder": (1.0, 50.0)}
"""How far each clock is ahead, s, and by how much it runs faster, ppm."""


class NoNamespaces(Exception):  # noqa: N818 - it names a reason
    """Why there can be none here."""


def run_ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, timeout=30)
    if done.returncode:
        raise NoNamespaces(f"ip {' '.join(words)}: {done.stderr.strip()}")


class Machines:
    """Namespaces by the names of their machines.

    Attributes:
        address: of each machine.
        centre: the address at which a machine of a star reaches the one in its centre.
        end: the machine's end of its cable.
    """

    def __init__(self) -> None:
        self.address: dict[str, str] = {}
        self.centre: dict[str, str] = {}
        self.end: dict[str, str] = {}
        self._spaces: dict[str, str] = {}

    def add(self, name: str) -> None:
        space = f"trilat-{os.getpid()}-{next(_numbers)}"
        run_ip("netns", "add", space)
        self._spaces[name] = space
        self.ip(name, "link", "set", "lo", "up")

    def ip(self, name: str, *words: str) -> None:
        run_ip("-n", self._spaces[name], *words)

    def cable(self, one: str, other: str) -> tuple[str, str]:
        number = next(_numbers)
        ends = f"t{number}a", f"t{number}b"
        there = ("netns", self._spaces[other])
        self.ip(one, "link", "add", ends[0], "type", "veth", "peer", "name", ends[1], *there)
        return ends

    def on(self, name: str) -> tuple[str, ...]:
        """The words before a command that is to run on a machine."""
        return ("ip", "netns", "exec", self._spaces[name])

    def part(self, one: str, other: str) -> None:
        """Cuts the way between two machines, both directions; the others see nothing of it."""
        for here, there in ((one, other), (other, one)):
            self.ip(here, "route", "add", "blackhole", self.address[there])

    def mend(self, one: str, other: str) -> None:
        for here, there in ((one, other), (other, one)):
            self.ip(here, "route", "del", "blackhole", self.address[there])

    def deafen(self, name: str, other: str, *, ends: bool = False) -> None:
        """Cuts the way from another machine to this one, and not the way back; or `ends` that.

        Raises:
            NoNamespaces: there is no `iptables`, or it may not.
        """
        self._use(
            name,
            "iptables",
            "-D" if ends else "-I",
            "INPUT",
            "-s",
            self.address[other],
            "-j",
            "DROP",
        )

    def shape(self, name: str, *queue: str) -> None:
        """Puts all that a machine sends into a queue of the tool `tc`; nothing of it is lost by another one.

        Raises:
            NoNamespaces: there is no `tc`, or its kernel has no such queue.
        """
        self._use(name, "tc", "qdisc", "replace", "dev", self.end[name], "root", *queue)

    def _use(self, name: str, *words: str) -> None:
        try:
            done = subprocess.run(
                [*self.on(name), *words], capture_output=True, text=True, timeout=30
            )
        except FileNotFoundError as error:
            raise NoNamespaces(str(error)) from None
        if done.returncode:
            raise NoNamespaces(f"{' '.join(words)}: {done.stderr.strip()}")

    def remove(self) -> None:
        """Removes all; cables go with their machines."""
        for space in self._spaces.values():
            with suppress(NoNamespaces):
                run_ip("netns", "del", space)


@contextmanager
def machines() -> Iterator[Machines]:
    """Machines that are gone at the end.

    Raises:
        NoNamespaces: there can be none here.
    """
    if shutil.which("ip") is None:
        raise NoNamespaces("there is no `ip` (iproute2)")
    if os.geteuid() != 0:
        raise NoNamespaces("network namespaces need root")
    made = Machines()
    try:
        for name in ("probe", "other probe"):  # as in a container, where root may not
            made.add(name)
        made.cable("probe", "other probe")
        made.ip("probe", "link", "add", "bridge", "type", "bridge")
        yield made
    finally:
        made.remove()


def connect_by_bridge(made: Machines, names: Sequence[str]) -> None:
    """Machines at one switch, which is a machine too; everybody reaches everybody."""
    made.add("switch")
    made.ip("switch", "link", "add", "bridge", "type", "bridge")
    made.ip("switch", "link", "set", "bridge", "up")
    for number, name in enumerate(names, 1):
        made.add(name)
        port, end = made.cable("switch", name)
        made.ip("switch", "link", "set", port, "master", "bridge", "up")
        _number(made, name, end, f"10.77.0.{number}")


def connect_as_star(made: Machines, centre: str, names: Sequence[str]) -> None:
    """Machines that reach the one in the centre and nobody else: each is in a network of its own."""
    made.add(centre)
    for number, name in enumerate(names, 1):
        made.add(name)
        port, end = made.cable(centre, name)
        made.centre[name] = f"10.77.{number}.254"
        _number(made, centre, port, made.centre[name])
        _number(made, name, end, f"10.77.{number}.1")


def _number(made: Machines, name: str, end: str, address: str) -> None:
    made.ip(name, "address", "add", f"{address}/24", "dev", end)
    made.ip(name, "link", "set", end, "up")
    made.address[name], made.end[name] = address, end


def can_reach(made: Machines, name: str, address: str) -> bool:
    """Whether a machine has a way to an address: a refused connection is an answer."""
    program = f"import socket; socket.create_connection(({address!r}, 1), 1)"
    knock = [*made.on(name), sys.executable, "-c", program]
    done = subprocess.run(knock, capture_output=True, text=True, timeout=10)
    assert "unreachable" in done.stderr or "refused" in done.stderr, done.stderr
    return "refused" in done.stderr


def list_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    return [pair for two in combinations(names, 2) for pair in (two, two[::-1])]


class Apart(Session):
    """Three sites and a recorder, each on its machine with its clock."""

    def __init__(self, stage: Stage, apart: Machines, *options: str) -> None:
        super().__init__(stage, "paper", PAPER, *options)
        self._apart, self.before = apart, {name: apart.on(name) for name in ALL}

    def ways(self, name: str) -> list[str]:
        """How the README says it: through a router, or by who listens where the others reach it."""
        offset_s, drift_ppm = CLOCKS[name]
        clock = ["--clock-offset-s", str(offset_s), "--clock-drift-ppm", str(drift_ppm)]
        if name in self._apart.centre:
            return [*clock, "--router", f"tcp/{self._apart.centre[name]}:7447"]
        others = PAPER if name == "recorder" else PAPER[: PAPER.index(name)]
        listen = () if name == "recorder" else ("--insecure", "--listen", PORT)
        return [
            *clock,
            *listen,
            *connection_options([f"tcp/{self._apart.address[other]}:7447" for other in others]),
        ]

    @classmethod
    def following(cls, stage: Stage, apart: Machines, duration_s: int) -> Self:
        """A session under `glide`, in which every site follows its peers."""
        session = cls(stage, apart, "--duration", str(duration_s), *GLIDE)
        session.all()
        session.begun()
        for name in PAPER:
            session.processes[name].prints(FOLLOWS)
        return session
