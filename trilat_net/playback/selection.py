"""Which messages of a log are played: by channel, and by time.

Law: what is not asked for is not played; by default that is what the sites published, and nothing else. The
recorder speaks for itself, and views of the file are no part of a session.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from ..core.grid import NS_PER_S
from ..errors import UsageError
from ..net import topics
from ..net.bus import matches

PLAYED = (topics.STATE, topics.LINK, topics.EVENT)
"""Channels of a site that are played unless others are asked for."""

Time = Literal["publish", "log"]
"""By which time: when a message was sent, or when it arrived."""


@dataclass(frozen=True, slots=True)
class Selection:
    """What is played of a log.

    Attributes:
        include: key expressions of the only channels that are played; none: every site's own.
        exclude: key expressions of channels that are not.
        start_ns: messages before this are not, ns since the epoch; None: from the first one on.
        stop_ns: messages after this are not; None: to the last one.
        time: by which time.
    """

    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    start_ns: int | None = None
    stop_ns: int | None = None
    time: Time = "publish"

    def takes(self, topic: str, sites: Collection[str]) -> bool:
        """Says whether a channel is played.

        Args:
            topic: its topic in the file, as in "/trilat/paper/m1/state".
            sites: the sites of the scenario.
        """
        key = topic.strip("/")
        if any(matches(expression, key) for expression in self.exclude):
            return False
        if self.include:
            return any(matches(expression, key) for expression in self.include)
        where = topics.address(key)
        return where is not None and where.member in sites and where.channel in PLAYED

    def holds(self, t_ns: int) -> bool:
        """Says whether an instant is played, ns since the epoch."""
        return (self.start_ns is None or t_ns >= self.start_ns) and (
            self.stop_ns is None or t_ns <= self.stop_ns
        )


def selected(
    include: Collection[str],
    exclude: Collection[str],
    start_s: float | None,
    stop_s: float | None,
    duration_s: float | None,
    time: Time,
) -> Selection:
    """Returns what a person asks for.

    Args:
        include: see `Selection`; a leading slash, as topics have it, is fine.
        exclude: the same.
        start_s: from when on, s since the epoch.
        stop_s: until when.
        duration_s: how long, instead of `stop_s`; counted from `start_s`, or from the epoch.
        time: by which time.

    Raises:
        UsageError: it cannot be meant.
    """
    for name, seconds in (("--start", start_s), ("--stop", stop_s), ("--duration", duration_s)):
        if seconds is not None and not (math.isfinite(seconds) and abs(seconds) <= 1e9):
            raise UsageError(f"{name} is a number of seconds, not {seconds:g}")
    if duration_s is not None and duration_s <= 0:
        raise UsageError(f"--duration is more than 0 s, not {duration_s:g}")
    if duration_s is not None and stop_s is not None:
        raise UsageError("--stop and --duration say the same in two ways; give one of them")
    if duration_s is not None:
        stop_s = (start_s or 0.0) + duration_s
    if start_s is not None and stop_s is not None and stop_s <= start_s:
        raise UsageError(f"--stop is after --start ({start_s:g} s), not {stop_s:g} s")
    return Selection(
        _expressions("--include", include),
        _expressions("--exclude", exclude),
        None if start_s is None else round(start_s * NS_PER_S),
        None if stop_s is None else round(stop_s * NS_PER_S),
        time,
    )


def _expressions(option: str, given: Collection[str]) -> tuple[str, ...]:
    """Refuses what is no key expression: it would match nothing, and say nothing."""
    for text in given:
        chunks = text.strip("/").split("/")
        if not all(chunk in ("*", "**") or (chunk and "*" not in chunk) for chunk in chunks):
            raise UsageError(
                f"{option} is a key expression like '**/state' or 'trilat/*/m1/**': chunks are names, "
                f"* or **; not {text!r}"
            )
    return tuple(text.strip("/") for text in given)
