"""Where numbers come from: versions, commit, platform. No path, no clock, no host name."""

import platform
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path

from ..core.fingerprint import fingerprint

_PACKAGES = ("trilat-net", "numpy", "numba", "msgpack", "msgspec", "mcap", "eclipse-zenoh")


def _git(*arguments: str) -> str | None:
    """Returns what git prints about this source tree, or None where it is no checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


@cache
def provenance() -> dict[str, str]:
    """Returns what a log must say of the program that made it."""
    commit = _git("rev-parse", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no")
    facts = {
        "commit": commit or "unknown",
        "commit_dirty": "unknown" if changed is None else str(bool(changed)).lower(),
        "fingerprint": fingerprint(),
        "platform": f"{platform.system()} {platform.machine()}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
    }
    for package in _PACKAGES:
        try:
            facts[f"version_{package}"] = metadata.version(package)
        except metadata.PackageNotFoundError:
            facts[f"version_{package}"] = "unknown"
    return facts
