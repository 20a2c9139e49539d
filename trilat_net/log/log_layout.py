"""Defines how a log is stored: the names of its files, its metadata and its channels.

A log holds the messages of a run in the MCAP file format. While it is being recorded, the file
is called run.mcap.active. A recording that is split consists of the files run-001.mcap,
run-002.mcap and so on. A channel contains the messages of one kind from one sender. The
metadata describe the session, the filter (which channels are recorded), and the versions of the
program (`log.provenance`).

Invariant:
    - A channel excluded by the filter appears neither in the file nor in the message counts.
      The file states the filter.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec

from ..errors import UsageError
from ..net import Event, LinkStats, RecorderStats, State, matches_key, topics

ACTIVE_SUFFIX = ".active"
"""Suffix of the name of a log file while it is being recorded."""
PART_STEM = re.compile(r"(.+)-(\d{3,})")
"""Stem of a part's file name: the stem of the log's name and the number of the part."""
_CHUNK = re.compile(r"\*\*?|(?:\$\*|[^*$#?])+", re.DOTALL)
"""Pattern for a valid part of a Zenoh key expression, between slashes."""


def active_path(path: Path) -> Path:
    """Returns the name of a log file while it is being recorded.

    This is the final name with the suffix `ACTIVE_SUFFIX`. A path without a file name, such as
    ".", is returned unchanged.

    Args:
        path: Final name of the file.
    """
    return path.with_name(path.name + ACTIVE_SUFFIX) if path.name else path


def describe_unfinished(path: Path) -> str:
    """Suggests how to recover a log that was never finished.

    A log has the suffix `.active` while it is being recorded. If a user asks for a log that
    does not exist but whose `.active` file does, the recording was probably interrupted.

    Args:
        path: The log that the user asked for.

    Returns:
        Text to append to an error message, with the name of the unfinished file and the command
        that recovers it. Empty if there is no such file, or if the log exists.
    """
    unfinished = active_path(path)
    if path.exists() or not unfinished.exists():
        return ""
    return (
        f"; but there is {unfinished}, whose recording was not finished; "
        f"recover the log with: trilat log recover {unfinished}"
    )


def part_path(path: Path, number: int) -> Path:
    """Returns the file name of a part of a long log: run-002.mcap for part 2 of run.mcap.

    Args:
        path: Name of the log.
        number: Number of the part, counted from 1. If 0, the name of the log is returned.
    """
    return path.with_name(f"{path.stem}-{number:03}{path.suffix}") if number else path


@dataclass(frozen=True, slots=True)
class ChannelFilter:
    """Selects which channels of a session are recorded, using Zenoh key expressions.

    A key expression is the key of a channel, optionally with wildcards.

    Attributes:
        include: Key expressions of channels to record. If empty, all channels are recorded.
        exclude: Key expressions of channels not to record, even if they are included.
    """

    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def accepts(self, key: str) -> bool:
        """Returns True if the user's filter selects a channel for recording.

        Args:
            key: Network key of the channel, such as "trilat/paper/m1/state".
        """
        if any(matches_key(expression, key) for expression in self.exclude):
            return False
        if not self.include:
            return True
        return any(matches_key(expression, key) for expression in self.include)

    def facts(self) -> Mapping[str, str]:
        """Converts the filter to strings for the metadata of a log.

        `ChannelFilter.parse_facts` converts them back to a filter.

        Returns:
            A mapping with the entries "include" and "exclude", which contain the key
            expressions, separated by spaces. An entry without key expressions is omitted.
        """
        texts = {"include": " ".join(self.include), "exclude": " ".join(self.exclude)}
        return {name: text for name, text in texts.items() if text}

    @classmethod
    def parse(cls, include: Collection[str], exclude: Collection[str]) -> "ChannelFilter":
        """Creates a filter from the command-line options `--include` and `--exclude`.

        A leading slash, as in topics, is ignored.

        Args:
            include: Key expressions given with `--include`.
            exclude: Key expressions given with `--exclude`.

        Raises:
            UsageError: A string is not a valid key expression and would match no channel.
        """
        for option, expressions in (("--include", include), ("--exclude", exclude)):
            for expression in expressions:
                names = expression.strip("/").split("/")
                if not all(_CHUNK.fullmatch(name) for name in names):
                    raise UsageError(
                        f"{option} must be a key expression such as 'trilat/*/m1/**' or "
                        f"'**/link', not {expression!r}: * stands for one name, ** for any "
                        "number of names, and $* for part of a name"
                    )
        return ChannelFilter(
            include=tuple(expression.strip("/") for expression in include),
            exclude=tuple(expression.strip("/") for expression in exclude),
        )

    @classmethod
    def parse_facts(cls, about: Mapping[str, str]) -> "ChannelFilter":
        """Reads from the metadata of a log which channels were recorded.

        The metadata contain the strings that `ChannelFilter.facts` returns.

        Args:
            about: Metadata of the session.

        Returns:
            The channel filter. It accepts all channels if the metadata contain no filter.
        """
        return cls(
            include=tuple(about.get("include", "").split()),
            exclude=tuple(about.get("exclude", "").split()),
        )


ALL_CHANNELS = ChannelFilter()
"""Filter that records all channels."""


VIZ_ROOT = "/viz/"
"""Prefix of the topics for viewers such as Foxglove."""
MAX_TIME_NS = (1 << 64) - 1
"""Largest time stamp of a message in a file, in ns. Later times are stored as this time."""
SESSION = "trilat.session"
"""Name of the metadata record that describes the session."""
PART = "trilat.part"
"""Name of the metadata record that states which part of a log the file is."""
ACCOUNTS = "trilat.accounts"
"""Name of the metadata record with the numbers of received and missing messages of each
channel.
"""
SCENARIO = "scenario.toml"
"""Name of the attachment that contains the text of the scenario."""
CHANNEL_TYPES: dict[str, type[msgspec.Struct]] = {
    topics.STATE: State,
    topics.LINK: LinkStats,
    topics.EVENT: Event,
    topics.STATS: RecorderStats,
}
"""Maps each channel to the type of its messages."""
EXECUTED_SITES_KEY = "rerun_executed"
"""Key of the session metadata that lists the sites that a rerun repeated. The records of the
other sites are copied from the original log.
"""
RERUN_DRIVER = "rerun"
"""Value of the metadata `driver` in the log of a rerun."""
SITE_CHANNELS = (topics.STATE, topics.LINK, topics.EVENT)
"""Channels of a site. Their messages are numbered, so that missing messages are noticed."""
RECORDER_CHANNELS = (topics.EVENT, topics.STATS)
"""Channels of the recorder."""
