"""Where results go.

Law: what is there is never overwritten unless it was asked for.
"""

import itertools
from pathlib import Path

from .errors import UsageError


def results_folder(folder: Path | None, name: str, *, force: bool) -> Path:
    """Makes a folder for results.

    Args:
        folder: which one, or None for the next free `runs/NAME-N`.
        name: what the run is called.
        force: whether a folder that holds something may be used.

    Raises:
        UsageError: it holds something, or cannot be made.
    """
    chosen = folder if folder is not None else _next_free(Path("runs"), name)
    try:
        if not force and chosen.exists() and any(chosen.iterdir()):
            raise UsageError(f"{chosen}: holds something; choose another folder, or use --force")
        chosen.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{chosen}: cannot be made or read: {error.strerror}") from None
    return chosen


def _next_free(parent: Path, name: str) -> Path:
    return next(path for n in itertools.count(1) if not (path := parent / f"{name}-{n:03d}").exists())
