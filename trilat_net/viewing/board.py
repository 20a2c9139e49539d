"""What of a log's standard channels is shown where: pages of plots, a column per site, a row per quantity.

Law: a plot has one unit, and every curve a name. What a log does not have takes no room.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from ..log.cdr import JOINT_STATE
from ..log.standard import EVENTS, LINES, Standard

Channels = Mapping[str, Standard]


class Curves(NamedTuple):
    """Curves of one channel.

    Attributes:
        entity: where Rerun puts their numbers.
        names: their names, in the order of the numbers.
        shown: which of them are shown.
    """

    entity: str
    names: tuple[str, ...]
    shown: tuple[bool, ...]


class Plot(NamedTuple):
    """One plot: its title, with the unit, and its curves."""

    title: str
    curves: tuple[Curves, ...]


Page = list[list[Plot]]
"""Rows of plots."""

_POSITION, _VELOCITY, _EFFORT = "position", "velocity", "effort"
_PAGES = {
    "Motion": (
        ("joint angles and reference", "rad", (("joint_states", _POSITION), ("reference", _POSITION))),
        ("error", "rad", (("error", ""),)),
        ("torque, and exogenous torque", "N m", (("joint_states", _EFFORT), ("tau_x", ""))),
    ),
    "Speeds, estimates": (
        ("joint velocities", "rad/s", (("joint_states", _VELOCITY), ("reference", _VELOCITY))),
        ("estimate", "kg m^2, kg m", (("theta_hat", ""),)),
        ("mode: run 1, diverged 2, hold 3, brake 4, return 5", "", (("mode", ""),)),
    ),
    "Links, timing": (
        ("age of samples in use, by peer", "ms", (("link_age", ""),)),
        ("one-way delay, by peer", "ms", (("link_delay", ""),)),
        ("clock offset, by peer", "ms", (("link_offset", ""),)),
        ("largest in 100 ms", "us", (("timing", ""),)),
    ),
}
"""Per page its rows: what, the unit, and the parts: channel, and of joint states which of their lists."""


class Board(NamedTuple):
    """All pages by name, and where the lines of what happened stand; "" where there are none."""

    pages: dict[str, Page]
    lines: str


def board(channels: Channels) -> Board:
    """Returns what to show of the standard channels of a log.

    Args:
        channels: those that there are, by topic: `<root>/<site>/<name>`, and of the session `<root>/log`.
    """
    session = [topic for topic in channels if topic.rpartition("/")[2] in (EVENTS, LINES)]
    roots = list(dict.fromkeys(topic.rpartition("/")[0] for topic in channels if topic not in session))
    pages = {
        name: [plots for what in rows if (plots := [*_row(channels, roots, *what)])]
        for name, rows in _PAGES.items()
    }
    lines = next((topic for topic in session if topic.endswith(f"/{LINES}")), "")
    return Board({name: page for name, page in pages.items() if page}, lines)


def _row(
    channels: Channels, roots: list[str], what: str, unit: str, parts: tuple[tuple[str, str], ...]
) -> Iterator[Plot]:
    """Yields a quantity of every site that has it."""
    for root in roots:
        curves = [
            curves
            for name, field in parts
            if (curves := _curves(f"{root}/{name}", field, channels.get(f"{root}/{name}"))) is not None
        ]
        if curves:
            site = root.rpartition("/")[2]
            yield Plot(f"{site}: {what}" + (f" ({unit})" if unit else ""), tuple(curves))


def _curves(topic: str, field: str, channel: Standard | None) -> Curves | None:
    """Returns the curves of a channel, or of a list of joint states."""
    if channel is None:
        return None
    names = _names(channel.about.get("names", ""))
    if channel.kind != JOINT_STATE:
        prefix = f"{topic.rpartition('/')[2]} " if topic.endswith("/tau_x") else ""
        return Curves(topic, tuple(f"{prefix}{name}" for name in names), (True,) * len(names))
    reference = all(name.endswith("_ref") for name in names) or topic.endswith("/reference")
    if field == _EFFORT and reference:
        return None
    if reference:
        names = tuple(name.removesuffix("_ref") + "_ref" for name in names)
    shown = tuple(reference or field == _POSITION or not name.endswith("_ref") for name in names)
    return Curves(f"{topic}/{field}", names, shown)


def _names(text: str) -> tuple[str, ...]:
    """Returns the names of the numbers of an array, from those along its dimensions: every one with every."""
    names = [""]
    for axis in text.split("; "):
        names = [f"{before} {name}".strip() for before in names for name in axis.split(" ")]
    return tuple(names)
