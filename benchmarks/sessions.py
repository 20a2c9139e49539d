"""Runs a session of real processes in a temporary folder."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.live.processes import Session, Stage

SITES = ("m1", "m2", "s")


@contextmanager
def paper(duration_s: int) -> Iterator[Session]:
    """Yields a session of `paper` whose processes have not been started yet, and ends all remaining processes."""
    with tempfile.TemporaryDirectory() as folder:
        stage = Stage(Path(folder))
        try:
            yield Session(stage, "paper", SITES, "--duration", str(duration_s))
        finally:
            stage.clear()
