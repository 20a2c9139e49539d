"""Simulated machines: network namespaces with separate addresses, joined by virtual cables.

Invariant:
- Nothing stays: every namespace of a test has a unique name and is removed at the end, also after errors.
- The network of the real machine is not touched.
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
"""The offset of each clock in s, and its drift in ppm."""


class NoNamespaces(Exception):  # noqa: N818 - it names a reason
    """The reason why network namespaces are not available."""


def run_ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, timeout=30)
    if done.returncode:
        raise NoNamespaces(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


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

    def ip(self, name: str, *arguments: str) -> None:
        run_ip("-n", self._spaces[name], *arguments)

    def cable(self, first: str, other: str) -> tuple[str, str]:
        number = next(_numbers)
        ends = f"t{number}a", f"t{number}b"
        other_space = ("netns", self._spaces[other])
        self.ip(
            first, "link", "add", ends[0], "type", "veth", "peer", "name", ends[1], *other_space
        )
        return ends

    def on(self, name: str) -> tuple[str, ...]:
        """Returns the words that precede a command in order to run the command on a machine."""
        return ("ip", "netns", "exec", self._spaces[name])

    def part(self, first: str, other: str) -> None:
        """Cuts the way between two machines in both directions, unnoticed by the others."""
        for sender, receiver in ((first, other), (other, first)):
            self.ip(sender, "route", "add", "blackhole", self.address[receiver])

    def mend(self, first: str, other: str) -> None:
        for sender, receiver in ((first, other), (other, first)):
            self.ip(sender, "route", "del", "blackhole", self.address[receiver])

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

    def _use(self, name: str, *command: str) -> None:
        try:
            done = subprocess.run(
                [*self.on(name), *command], capture_output=True, text=True, timeout=30
            )
        except FileNotFoundError as error:
            raise NoNamespaces(str(error)) from None
        if done.returncode:
            raise NoNamespaces(f"{' '.join(command)}: {done.stderr.strip()}")

    def remove(self) -> None:
        """Removes all; cables go with their machines."""
        for space in self._spaces.values():
            with suppress(NoNamespaces):
                run_ip("netns", "del", space)


@contextmanager
def make_machines() -> Iterator[Machines]:
    """Machines that are gone at the end.

    Raises:
        NoNamespaces: there can be none here.
    """
    if shutil.which("ip") is None:
        raise NoNamespaces("there is no `ip` (iproute2)")
    if os.geteuid() != 0:
        raise NoNamespaces("network namespaces need root")
    all_machines = Machines()
    try:
        for name in ("probe", "other probe"):  # as in a container, where root may not
            all_machines.add(name)
        all_machines.cable("probe", "other probe")
        all_machines.ip("probe", "link", "add", "bridge", "type", "bridge")
        yield all_machines
    finally:
        all_machines.remove()


def connect_by_bridge(all_machines: Machines, names: Sequence[str]) -> None:
    """Connects machines by one switch, which is a machine too, so that each reaches all others."""
    all_machines.add("switch")
    all_machines.ip("switch", "link", "add", "bridge", "type", "bridge")
    all_machines.ip("switch", "link", "set", "bridge", "up")
    for number, name in enumerate(names, 1):
        all_machines.add(name)
        port, end = all_machines.cable("switch", name)
        all_machines.ip("switch", "link", "set", port, "master", "bridge", "up")
        _assign_address(all_machines, name, end, f"10.77.0.{number}")


def connect_as_star(all_machines: Machines, centre: str, names: Sequence[str]) -> None:
    """Connects each machine to the central one only, by a separate network."""
    all_machines.add(centre)
    for number, name in enumerate(names, 1):
        all_machines.add(name)
        port, end = all_machines.cable(centre, name)
        all_machines.centre[name] = f"10.77.{number}.254"
        _assign_address(all_machines, centre, port, all_machines.centre[name])
        _assign_address(all_machines, name, end, f"10.77.{number}.1")


def _assign_address(all_machines: Machines, name: str, end: str, address: str) -> None:
    all_machines.ip(name, "address", "add", f"{address}/24", "dev", end)
    all_machines.ip(name, "link", "set", end, "up")
    all_machines.address[name] = address
    all_machines.end[name] = end


def can_reach(all_machines: Machines, name: str, address: str) -> bool:
    """Returns True if a machine can reach an address; a refused connection counts as reached."""
    program = f"import socket; socket.create_connection(({address!r}, 1), 1)"
    knock = [*all_machines.on(name), sys.executable, "-c", program]
    done = subprocess.run(knock, capture_output=True, text=True, timeout=10)
    assert "unreachable" in done.stderr or "refused" in done.stderr, done.stderr
    return "refused" in done.stderr


def list_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    return [pair for two in combinations(names, 2) for pair in (two, two[::-1])]


class Apart(Session):
    """Returns a session of three sites and a recorder, each on its machine with its clock."""

    def __init__(self, stage: Stage, apart: Machines, *options: str) -> None:
        super().__init__(stage, "paper", PAPER, *options)
        self._apart = apart
        self.before = {name: apart.on(name) for name in ALL}

    def ways(self, name: str) -> list[str]:
        """Returns the options of a member, as the README states them: by a router, or by endpoints."""
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
        """Starts a session under `glide`, and returns once every site follows its peers."""
        session = cls(stage, apart, "--duration", str(duration_s), *GLIDE)
        session.all()
        session.begun()
        for name in PAPER:
            session.processes[name].prints(FOLLOWS)
        return session
