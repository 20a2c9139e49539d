"""Layout of a log: names of files, metadata and channels, the channel filter, and provenance.

Invariant: a channel that the filter excludes is neither in the file nor in its accounts, and
the file states the filter. Provenance holds versions, commit and platform, but no path, time or
host name.
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
_NUMBER = re.compile(r"(.+)-(\d{3,})")
_CHUNK = re.compile(r"\*\*?|(?:\$\*|[^*$#?])+", re.DOTALL)
"""A part of a key expression, between slashes."""


def active_path(path: Path) -> Path:
    """Returns the name of a log while it is written; "." is a folder, and refused as one."""
    return path.with_name(path.name + ACTIVE_SUFFIX) if path.name else path


def describe_unfinished(path: Path) -> str:
    """Returns a hint at an unfinished log of a name that is not there; else ""."""
    if path.exists() or not active_path(path).exists():
        return ""
    torn = active_path(path)
    return f"; {torn} is there, which was not finished; make it whole with: trilat log recover {torn}"


def part_path(path: Path, number: int) -> Path:
    """Returns the name of a part: that of the log with a number, or the log's own for part 0."""
    return path.with_name(f"{path.stem}-{number:03}{path.suffix}") if number else path


def find_parts(path: Path) -> dict[int, Path]:
    """Returns the files of a log that are there, finished or not, by number; one without number
    is part 1.
    """
    found: dict[int, Path] = {}
    for name in (path, active_path(path)):
        if name.exists():
            found.setdefault(1, name)
    for name in sorted(path.parent.glob(f"{glob.escape(path.stem)}-*")):
        bare = name.with_name(name.name.removesuffix(ACTIVE_SUFFIX))
        number = _NUMBER.fullmatch(bare.stem)
        if number and number[1] == path.stem and bare.suffix == path.suffix:
            found.setdefault(int(number[2]), name)
    return found


@dataclass(frozen=True, slots=True)
class ChannelFilter:
    """Filter of channels by key expressions; an empty `include` takes all that `exclude` does
    not match.
    """

    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def accepts(self, key: str) -> bool:
        """True if the filter takes a channel."""
        included, excluded = (
            any(matches_key(expression, key) for expression in expressions)
            for expressions in (self.include, self.exclude)
        )
        return not excluded and (included or not self.include)

    def facts(self) -> Mapping[str, str]:
        """Returns the filter as metadata of the session; {} if it takes all."""
        texts = {"include": " ".join(self.include), "exclude": " ".join(self.exclude)}
        return {name: text for name, text in texts.items() if text}


ALL_CHANNELS = ChannelFilter()


def parse_channel_filter(include: Collection[str], exclude: Collection[str]) -> ChannelFilter:
    """Returns the filter for the options of a command; a leading slash, as topics have it, is
    ignored.

    Raises:
        UsageError: a text is no key expression; it would silently match nothing.
    """
    for option, texts in (("--include", include), ("--exclude", exclude)):
        for text in texts:
            if not all(map(_CHUNK.fullmatch, text.strip("/").split("/"))):
                raise UsageError(
                    f"{option} is a key expression like 'trilat/*/m1/**' or '**/link': names, * for one of "
                    f"them, ** for any number, $* for a part of one; not {text!r}"
                )
    return ChannelFilter(
        *(tuple(text.strip("/") for text in texts) for texts in (include, exclude))
    )


def parse_filter_facts(about: Mapping[str, str]) -> ChannelFilter:
    """Returns the filter that the metadata of a session state, see `ChannelFilter.facts`."""
    return ChannelFilter(
        tuple(about.get("include", "").split()), tuple(about.get("exclude", "").split())
    )


_PACKAGES = ("numpy", "numba", "msgpack", "msgspec", "mcap", "eclipse-zenoh")


def _git(*arguments: str) -> str | None:
    """Returns the output of git for this source tree, or None if it is no checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), *arguments]
    try:
        done = subprocess.run(
            command, capture_output=True, encoding="utf-8", check=True, timeout=10
        )
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


@cache
def collect_provenance() -> dict[str, str]:
    """Returns versions, commit and platform of the program."""
    commit = _git("rev-parse", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no")
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
"""How topics of channels for viewers begin."""
MAX_TIME_NS = (1 << 64) - 1
"""Largest time stamp of a message in a file; longer ones of others are cut to it."""
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
"""Entry of the session's metadata in a log that a rerun wrote: the sites that it executed."""
RERUN_DRIVER = "rerun"
"""Driver of such a log."""
SITE_CHANNELS = (topics.STATE, topics.LINK, topics.EVENT)
"""Channels of a site, each with a number per message that tells what is missing."""
RECORDER_CHANNELS = (topics.EVENT, topics.STATS)
