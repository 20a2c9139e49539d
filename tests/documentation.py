"""The blocks of the documentation: which there are, and what a test does with each.

Invariant: a block of a language, or of commands, is run by `tests/test_documentation.py`, or it stands in
ELSEWHERE with the test that runs it, or in NOT_RUN with the reason; the others are formulas and listings.
"""

import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")),
]
_BLOCK = re.compile(
    r"^```(?P<language>\w*)\n(?P<fenced>.*?)^```$|(?P<indented>(?:^ {4}[^\n]*\n(?:\n(?= {4}))?)+)",
    re.DOTALL | re.MULTILINE,
)
_PROGRAM = re.compile(r"(?:\$ )?(?:[A-Z]+=\S+ )?(trilat|make|docker|dask|export|uvx|pip) ")
_CODE = re.compile(r"(?:from|import) \w+")


class Block(NamedTuple):
    """A block of a page in "python", "toml", "sh" for commands, or "" for text that is only shown."""

    page: str
    language: str
    text: str

    @property
    def name(self) -> str:
        """The page and the first line of the block."""
        return f"{self.page}: {self.text.splitlines()[0].strip()}"


@cache
def find_blocks(page: str) -> tuple[Block, ...]:
    """Returns the blocks of a page, in order."""
    blocks = []
    for match in _BLOCK.finditer((ROOT / page).read_text(encoding="utf-8")):
        text = match["fenced"] if match["fenced"] is not None else _unindent(match["indented"])
        stated = match["language"] or ""
        guessed = "sh" if _PROGRAM.match(text) else "python" if _CODE.match(text) else ""
        blocks.append(
            Block(page, guessed if stated == "" else stated.replace("text", ""), text)
        )
    return tuple(blocks)


def _unindent(text: str) -> str:
    return re.sub(r"^ {4}", "", text, flags=re.MULTILINE).rstrip() + "\n"


def read_commands(text: str) -> Iterator[tuple[list[str], list[str]]]:
    """Yields the words of every command of a block, and the lines of output that the block
    shows for it.

    Options in [--brackets] are optional, and are given.
    """
    lines = re.sub(r"\[(--[^\]]*)\]", r"\1", text.replace("\\\n", " ")).splitlines()
    shows = any(line.startswith("$ ") for line in lines)
    commands: list[tuple[list[str], list[str]]] = []
    for line in lines:
        if shows and not line.startswith("$ "):
            if line.strip() != "...":
                commands[-1][1].append(" ".join(line.split("   #")[0].split()))
            continue
        parts = re.split(r"  {2,}(?=[a-z])", line.removeprefix("$ "))[0].split(" && ")
        commands.extend(
            (arguments, []) for part in parts if (arguments := shlex.split(part, comments=True))
        )
    yield from commands


ELSEWHERE = {
    "README.md": ".ci/readme",
    "docs/commands.md": ".ci/readme",
    "docs/studies/bench.md: trilat bench --small": "packages/trilat-studies/tests/command_tests/test_benches.py",
    "docs/sessions/code-that-runs.md: trilat verify": "tests/cli/test_code_from_logs.py",
    "docs/sessions/code-that-runs.md: log = tn.open_log": "tests/cli/test_code_from_logs.py",
    "docs/sessions/devices.md: import trilat_net": "packages/trilat-people/tests/device_tests/test_device_hand.py",
    "docs/sessions/devices.md: trilat hand": "packages/trilat-people/tests/live_tests/test_devices.py",
    "docs/sessions/devices.md: trilat keys new": "packages/trilat-people/tests/live_tests/test_headset.py",
    "docs/studies/experiments.md: trilat experiment new": "packages/trilat-people/tests/experiment_tests/test_experiment_commands.py",
    "docs/sessions/keys.md: trilat keys new": "tests/live/test_namespaces.py",
    "docs/sessions/keys.md: trilat keys renew": "tests/net/test_member_keys.py",
    "docs/sessions/keys.md: trilat keys add": "tests/net/test_member_keys.py",
    "docs/sessions/external-arm.md: import trilat_net": "tests/sites/test_external_arm.py",
    "docs/tutorials/first-hour.md: trilat live": "packages/trilat-people/tests/live_tests/test_live_page.py",
    "docs/gallery.md": "tests/test_media.py",
    "docs/tutorials/lab.md: trilat": "tests/test_lab.py",
    "docs/studies/lerobot.md: $ trilat log export session": "tests/cli/test_log_export.py",
    "docs/studies/lerobot.md: $ make extras": "packages/lerobot_robot_trilat/tests/lerobot_tests/test_lerobot_plugins.py",
    "docs/studies/lerobot.md: $ trilat demo play": "tests/live/test_lerobot.py",
    "docs/studies/lerobot.md: $ trilat log export reach-log": "packages/lerobot_robot_trilat/tests/lerobot_tests/test_lerobot_plugins.py",
    "docs/sessions/live-page.md: trilat live": "packages/trilat-people/tests/live_tests/test_live_page.py",
    "docs/studies/measured-hands.md: trilat identify hand": "tests/cli/test_linears.py",
    "docs/logs/replay.md: trilat replay": "tests/live/test_replay.py",
    "docs/maps/README.md: $ trilat sweep runs/mine": "packages/trilat-studies/tests/command_tests/test_sweeps.py",
    "docs/maps/README.md: trilat sweep SCENARIO": "packages/trilat-studies/tests/command_tests/test_sweeps.py",
    "docs/sessions/network.md: trilat keys new keys m1 m2 s recorder operator --host": "tests/live/test_namespaces.py",
    "docs/sessions/network.md: trilat keys new keys m1 m2 s recorder operator router": "tests/live/test_routers.py",
    "docs/sessions/network-check.md: trilat ping --answer": "tests/sites/test_network_benchmark.py",
    "docs/sessions/network-check.md: trilat ping --session": "tests/live/test_clocks.py",
    "docs/sessions/network-check.md: trilat doctor": "tests/sites/test_doctor.py",
    "docs/sessions/network.md: trilat site m2 --scenario glide.toml": "tests/live/test_returning.py",
    "docs/extend/own-controller.md: trilat sim paper": "tests/cli/test_outside.py",
    "docs/sessions/recording.md: trilat record": "tests/live/test_recording.py",
    "docs/sessions/ros2.md: trilat": "tests/live/test_ros2.py",
    "docs/sessions/two-operators.md: trilat": "tests/live/test_routers.py",
    "docs/tutorials/two-people.md: trilat experiment new": "packages/trilat-people/tests/experiment_tests/test_experiment_commands.py",
    "docs/tutorials/two-people.md: trilat experiment run": "packages/trilat-people/tests/live_tests/test_experiment_sessions.py",
    "docs/tutorials/two-people.md: trilat experiment analyse": "packages/trilat-people/tests/experiment_tests/test_experiment_analysis.py",
    "docs/theory/growth-exponents.md: $ trilat sweep p_d_margin": "packages/trilat-studies/tests/sweep_tests/test_exponents.py",
    "docs/studies/sweep.md: $ trilat sweep p_d_margin": "packages/trilat-studies/tests/command_tests/test_sweeps.py",
    "docs/studies/sweep.md: $ dask scheduler": "packages/trilat-studies/tests/test_dask_cluster.py",
}
"""First lines of blocks that need machines, a robot, a session or minutes, with the tests that cover them."""

NOT_RUN = {
    "docs/maps/README.md: trilat sweep contact": "1 640 runs: minutes; it draws a map of the page",
    "docs/maps/README.md: trilat sweep jitter": "2 200 runs: minutes; it draws a map of the page",
    "docs/maps/README.md: trilat sweep p_d_margin --duration 20 --over": "1 640 runs: minutes; it draws a map",
    "docs/maps/README.md: trilat sweep p_d_margin_two": "3 135 runs: minutes; it draws a map of the page",
    "docs/maps/README.md: trilat sweep free": "870 runs: minutes; it draws a map of the page",
    "docs/sessions/ros2.md: export RMW": "needs an installation of ROS 2",
    "docs/sessions/two-operators.md: ZENOH_CONFIG_OVERRIDE": "needs an installation of ROS 2",
    "docs/sessions/ros2.md: ros2": "needs an installation of ROS 2",
    "docs/sessions/ros2.md: import rclpy": "needs an installation of ROS 2",
    "docs/studies/train-policies.md: from stable_baselines3": "needs Stable-Baselines3; done by hand",
    "docs/sessions/network.md: docker compose up": "needs a container engine: .ci/compose starts the first",
}
"""First lines of blocks of which only the words are checked, with the reason."""


def find_exception(block: Block) -> str:
    """Returns the test or the reason of a block that is not run here; "" if it is."""
    tables = {**ELSEWHERE, **NOT_RUN}
    return next((why for name, why in tables.items() if block.name.startswith(name)), "")
