"""Collects the versions of the program and its packages, which are stored in every log.

They make it possible to repeat a run later with the same program (law L5 of
docs/develop/design.md).

Invariant:
    - The provenance contains versions, commit and platform, but no path, time or host name, so
      that equal runs have equal logs.
"""

import platform
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path

from ..core import compute_fingerprint
from ..files import find_version

_PACKAGES = ("numpy", "numba", "msgpack", "msgspec", "mcap", "eclipse-zenoh")
"""Packages whose versions are part of the provenance."""


def _run_git(*arguments: str) -> str | None:
    """Runs git in the source tree of this program, to determine its version.

    Args:
        *arguments: Arguments for git, such as "rev-parse", "HEAD".

    Returns:
        The output, or None if the source tree is not a git checkout or git fails.
    """
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
    """Collects the facts about this program that explain how a log was produced.

    Returns:
        Versions of the program and its packages, commit and platform, as metadata for a log.
        Paths, times and host names are excluded so that equal runs have equal logs.
    """
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
