"""Define the layout of a log: file names, metadata, channels, channel filter and provenance.

Invariant:
    - A channel that the filter excludes is neither in the file nor in its accounts. The file
      states the filter.
    - The provenance holds versions, commit and platform, but no path, time or host name.
"""

import glob
import platform
import re
import subprocess
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

import msgspec

from ..core.fingerprint import compute_fingerprint
from ..errors import UsageError
from ..files import find_version
from ..net import topics
from ..net.bus import matches_key
from ..net.messages import Event, LinkStats, RecorderStats, State

ACTIVE_SUFFIX = ".active"
"""Ending of a file's name until it is complete."""
_PART_STEM = re.compile(r"(.+)-(\d{3,})")
"""Stem of a part's file name: stem of the log, and number of the part."""
_CHUNK = re.compile(r"\*\*?|(?:\$\*|[^*$#?])+", re.DOTALL)
"""A part of a key expression, between slashes."""


def active_path(path: Path) -> Path:
    """Returns the name of a log while it is written.

    A path without a name, such as ".", is returned as it is, and is refused as a folder.
    """
    return path.with_name(path.name + ACTIVE_SUFFIX) if path.name else path


def describe_unfinished(path: Path) -> str:
    """Returns a hint at an unfinished log if the finished log does not exist; else ""."""
    unfinished = active_path(path)
    if path.exists() or not unfinished.exists():
        return ""
    return (
        f"; {unfinished} is there, which was not finished; "
        f"make it whole with: trilat log recover {unfinished}"
    )


def part_path(path: Path, number: int) -> Path:
    """Returns the name of a part of a log; number 0 is the log itself."""
    return path.with_name(f"{path.stem}-{number:03}{path.suffix}") if number else path


def find_parts(path: Path) -> dict[int, Path]:
    """Returns the existing files of a log, finished or not, by the number of the part.

    A file without a number is part 1.
    """
    parts: dict[int, Path] = {}
    for file in (path, active_path(path)):
        if file.exists():
            parts.setdefault(1, file)
    for file in sorted(path.parent.glob(f"{glob.escape(path.stem)}-*")):
        finished = file.with_name(file.name.removesuffix(ACTIVE_SUFFIX))
        match = _PART_STEM.fullmatch(finished.stem)
        if match and match[1] == path.stem and finished.suffix == path.suffix:
            parts.setdefault(int(match[2]), file)
    return parts


@dataclass(frozen=True, slots=True)
class ChannelFilter:
    """A filter of channels by key expressions.

    Attributes:
        include: expressions of accepted channels; empty: all channels.
        exclude: expressions of channels that are not accepted, even if they are included.
    """

    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def accepts(self, key: str) -> bool:
        """True if the filter accepts a channel, by its key."""
        if any(matches_key(expression, key) for expression in self.exclude):
            return False
        return not self.include or any(
            matches_key(expression, key) for expression in self.include
        )

    def facts(self) -> Mapping[str, str]:
        """Returns the filter as metadata of the session; {} if it accepts all channels."""
        texts = {"include": " ".join(self.include), "exclude": " ".join(self.exclude)}
        return {name: text for name, text in texts.items() if text}


ALL_CHANNELS = ChannelFilter()
"""The filter that accepts all channels."""


def parse_channel_filter(include: Collection[str], exclude: Collection[str]) -> ChannelFilter:
    """Returns the filter that the options of a command describe.

    A leading slash, as in topics, is ignored.

    Args:
        include: key expressions of `--include`.
        exclude: key expressions of `--exclude`.

    Raises:
        UsageError: a text is not a key expression, and would match no channel.
    """
    for option, texts in (("--include", include), ("--exclude", exclude)):
        for text in texts:
            if not all(map(_CHUNK.fullmatch, text.strip("/").split("/"))):
                raise UsageError(
                    f"{option} is a key expression like 'trilat/*/m1/**' or '**/link': names, "
                    f"* for one of them, ** for any number, $* for a part of one; not {text!r}"
                )
    return ChannelFilter(
        include=tuple(text.strip("/") for text in include),
        exclude=tuple(text.strip("/") for text in exclude),
    )


def parse_filter_facts(about: Mapping[str, str]) -> ChannelFilter:
    """Returns the filter that the metadata of a session state, see `ChannelFilter.facts`."""
    return ChannelFilter(
        include=tuple(about.get("include", "").split()),
        exclude=tuple(about.get("exclude", "").split()),
    )


_PACKAGES = ("numpy", "numba", "msgpack", "msgspec", "mcap", "eclipse-zenoh")
"""Packages whose versions are part of the provenance."""


def _run_git(*arguments: str) -> str | None:
    """Returns the output of git for this source tree; None if it is not a checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), *arguments]
    try:
        completed = subprocess.run(
            command, capture_output=True, encoding="utf-8", check=True, timeout=10
        )
        return completed.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


@cache
def collect_provenance() -> dict[str, str]:
    """Returns versions, commit and platform of the program, as metadata of a log."""
    commit = _run_git("rev-parse", "HEAD")
    changed = _run_git("status", "--porcelain", "--untracked-files=no")
    facts = {
        "commit": commit or "unknown",
        "commit_dirty": "unknown" if changed is None else str(bool(changed)).lower(),
        "fingerprint": compute_fingerprint(),
        "platform": f"{platform.system()} {platform.machine()}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "version_trilat-net": find_version(),
    }
    for package in _PACKAGES:
        try:
            facts[f"version_{package}"] = metadata.version(package)
        except metadata.PackageNotFoundError:
            facts[f"version_{package}"] = "unknown"
    return facts


VIZ_ROOT = "/viz/"
"""Prefix of the topics of channels for viewers."""
MAX_TIME_NS = (1 << 64) - 1
"""Largest time stamp of a message in a file; larger times are reduced to it."""
SESSION = "trilat.session"
PART = "trilat.part"
ACCOUNTS = "trilat.accounts"
SCENARIO = "scenario.toml"
CHANNEL_TYPES: dict[str, type[msgspec.Struct]] = {
    topics.STATE: State,
    topics.LINK: LinkStats,
    topics.EVENT: Event,
    topics.STATS: RecorderStats,
}
EXECUTED_SITES_KEY = "rerun_executed"
"""Key of the session's metadata, in the log of a rerun: the sites that the rerun executed."""
RERUN_DRIVER = "rerun"
"""Driver of the log of a rerun."""
SITE_CHANNELS = (topics.STATE, topics.LINK, topics.EVENT)
"""Channels of a site. Their messages are numbered, so that missing messages are known."""
RECORDER_CHANNELS = (topics.EVENT, topics.STATS)
"""Channels of the recorder."""
