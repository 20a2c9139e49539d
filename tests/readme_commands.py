"""The commands of README.md's table and of docs/commands.md, with real arguments.

`.ci/readme` runs them after `make setup` alone.

Invariant:
- Every command that docs/commands.md lists stands here or in a fenced block of one of the
  pages (`list_missing_commands`).
- Every command of the README's table stands here as it stands there, apart from names of logs, the address
  HOST, and options that follow (`list_unlike_commands`).
- A chain runs one command after another; chains run side by side and share no file but those that
  `FIRST` made.
- What would go on until somebody ends it is bounded by its own options, or interrupted (`LiveSession`).
"""

import re
import shlex
from pathlib import Path
from typing import NamedTuple

from .documentation import find_blocks, read_commands

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/commands.md")
"""Pages whose blocks and tables `.ci/readme` runs."""

FIRST = [
    "trilat sim two_sites --duration 20 -o sim.mcap",
    "trilat keys pair lab",
]
"""Commands that write the files which several chains need."""

SHORTEN = (
    r"sed -i -E '/^\[conditions\.(delay_100|jitter_300)\]/,/^$/d; "
    r"s/^(participants) = .*/\1 = 2/; s/^(trials) = .*/\1 = 1/; s/^(practice) = .*/\1 = 0/' reaching.toml"
)
"""A program that shortens an experiment to two participants, with a trial in each of two conditions."""

CHAINS = [
    [
        "trilat verify sim.mcap",
        "trilat certify sim.mcap",
        "trilat twin sim.mcap --at 1",
        "trilat metrics sim.mcap",
        "trilat rerun sim.mcap --replace s --set control.Kd=15 -o kd15.mcap",
        "trilat compare sim.mcap kd15.mcap",
        "trilat report sim.mcap",
        "trilat figure sim.mcap --with kd15.mcap -o figures",
        "trilat sim two_people -o handover.mcap",
        "trilat report handover.mcap",
        "trilat certify handover.mcap",
        "trilat rerun handover.mcap --closed-loop --set link.delay_ms=800 -o slow.mcap",
        "trilat compare handover.mcap slow.mcap",
    ],
    [
        "trilat log info sim.mcap",
        "trilat log check sim.mcap",
        "trilat log sign sim.mcap --key lab.key",
        "trilat log check sim.mcap --key lab.pub",
        "trilat log export sim.mcap --to csv",
        "trilat log export sim.mcap --to ros2",
        "trilat log recover sim.mcap",
        "cp sim.mcap seen.mcap",
        "trilat log view seen.mcap",
        "trilat keys new keys m1 m2 s recorder",
        "trilat keys renew keys",
        "trilat keys add keys probe",
        "trilat keys info keys/m1",
        "trilat doctor",
    ],
    [
        "trilat scenario list",
        "trilat scenario show paper",
        "trilat scenario check paper",
        "trilat scenario new mine.toml",
        "trilat scenario check mine.toml",
        "trilat test two_sites",
        "trilat new law mylaw.py",
        "trilat new hand myhand.py",
        "trilat new plant myplant.py",
        "trilat linear free",
        "trilat tune --arm arm6.urdf --delay 40ms",
        "trilat compare --tune free --law p_d --budget 2 --duration 2 --jobs 1 -o tuned",
    ],
    [
        "trilat sweep free --over link.delay_ms=20,100 --set link.model=uniform --duration 1 --longest 1 "
        "--jobs 1 -o swept",
        "trilat sweep swept --cell 0",
        "trilat sweep p_d_margin --over link.delay_ms=0:1600:400 --over control.d=0.5:3:0.5 --map "
        "--duration 1 --longest 1 --jobs 1 -o mapped",
        "trilat bench --task free --law p_d --link rtt68 --seeds 1 --jobs 1 -o suite",
        "trilat experiment new two-people.toml --pair",
        "trilat experiment check two-people.toml",
        "trilat experiment new reaching.toml",
        SHORTEN,
        "trilat experiment check reaching.toml",
        "trilat experiment power 0.8 --participants 16",
        "trilat experiment run reaching.toml --jobs 1 -o reaching",
        "trilat experiment status reaching",
        "trilat experiment analyse reaching",
    ],
]
"""Chains of commands without a network; each runs in its own folder, which has the files of `FIRST`."""


class LiveSession(NamedTuple):
    """A session, and what is done with it while it runs.

    Attributes:
        start: begins the session, in which m2 starts too fast and is in fault, so that there is something to
            reset; it is interrupted at the end, as by Ctrl-C.
        watch: goes on until the session ends.
        meanwhile: one after another, once the session answers.
    """

    start: str
    watch: str
    meanwhile: list[str]


LIVE = LiveSession(
    "trilat live play --set sites.m2.qd0_rad_s=[8.0,0.0] --duration 600 --no-browser",
    "trilat watch --session play --timeout 60",
    [
        "trilat ping --session play --timeout 60",
        "trilat reset --session play m2",
        "trilat set --session play link 'm1->s' --delay 350ms --loss 5%",
        "trilat set --session play dominance s m1=0.9 m2=0.1 --ramp 1s",
        "trilat stop --session play",
        "trilat enable --session play",
    ],
)
ALONE = [
    "trilat demo two_sites --duration 1",
    "trilat replay sim.mcap --rate max",
]
"""Commands that use the network of this machine, in this order, after the live session."""
AGAINST = {
    "trilat ping --benchmark p_d_margin --connect tcp/127.0.0.1:7447 --seconds 2": (
        "trilat ping --answer tcp/0.0.0.0:7447 --insecure"
    )
}
"""Commands that need another machine, here this one, each with the command that runs there until Ctrl-C."""
INTERRUPTED = {"trilat router": "listening at"}
"""Commands that run until Ctrl-C, each with the text that it prints once it works."""
ENDED_BY_CTRL_C = (0, 130)


def list_all() -> list[str]:
    """Returns every command of this module."""
    chained = [command for chain in CHAINS for command in chain]
    made_against = [*AGAINST, *AGAINST.values()]
    return [
        *FIRST,
        *chained,
        LIVE.start,
        LIVE.watch,
        *LIVE.meanwhile,
        *ALONE,
        *made_against,
        *INTERRUPTED,
    ]


def read_listed_commands() -> set[str]:
    """Returns the commands and groups that the lists of docs/commands.md name, as in "log info" and "keys"."""
    text = (ROOT / "docs/commands.md").read_text(encoding="utf-8")
    named: set[str] = set()
    for row in re.findall(r"^- (`trilat .*?`): ", text, re.MULTILINE):
        for code in re.findall(r"`trilat ([^`]*)`", row):
            parts = [
                re.sub(r"\[.*?\]|--\S.*|\b[A-Z]{1,}\b.*", "", part).split()
                for part in code.split(" / ")
            ]
            group = parts[0][:-1] if len(parts) > 1 else []
            named |= {
                " ".join([*group, *arguments] if n else arguments)
                for n, arguments in enumerate(parts)
                if arguments
            }
    return {name.split(" '")[0] for name in named}


def list_missing_commands(commands: set[str]) -> set[str]:
    """The commands of the program that the page lists and that nothing runs.

    Args:
        commands: all commands of the program, as in "log info".
    """
    run = [shlex.split(command)[1:] for command in list_all() if command.startswith("trilat ")]
    for page in PAGES:
        for block in find_blocks(page):
            run += [
                arguments[1:]
                for arguments, _ in read_commands(block.text)
                if arguments[0] == "trilat"
            ]
    done = {f"{arguments[0]} {word}" for arguments in run for word in arguments[1:]} | {
        arguments[0] for arguments in run
    }
    named = read_listed_commands()
    assert all(
        name in commands or any(documented.startswith(f"{name} ") for documented in commands)
        for name in named
    )
    wanted = {
        documented
        for documented in commands
        if documented in named or any(documented.startswith(f"{name} ") for name in named)
    }
    return {documented for documented in wanted if documented not in done}


def read_wishes() -> list[tuple[str, list[str]]]:
    """Returns the rows of the README's table: what somebody wants, and the commands for it."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = text.partition("| I want to … | command |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| (.+?) \| (`.+`) \|$", table, re.MULTILINE)
    return [(wish, re.split(r" && |` `", cell.strip("`"))) for wish, cell in rows]


def list_unlike_commands() -> list[str]:
    """Returns the commands of the README's table that no command of this file begins with."""
    run = [_drop_log_names(command) for command in list_all()]
    return [
        command
        for _, commands in read_wishes()
        for command in commands
        if not any(
            f"{executed} ".startswith(f"{_drop_log_names(command)} ") for executed in run
        )
    ]


def _drop_log_names(command: str) -> str:
    """Returns a command in which every log has the same name, and the other machine is this one."""
    return re.sub(r"\S+\.mcap", "run.mcap", command.replace("/HOST:", "/127.0.0.1:"))
