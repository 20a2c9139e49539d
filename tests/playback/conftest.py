import io
from pathlib import Path

import pytest

from trilat_net.scenario import load
from trilat_net.sim import virtual


@pytest.fixture(scope="session")
def short_log() -> bytes:
    """The bytes of a log of 0.3 s of virtual time."""
    stream = io.BytesIO()
    virtual.record(load("paper", {"duration_s": 0.3}), stream)
    return stream.getvalue()


@pytest.fixture
def log_file(short_log: bytes, tmp_path: Path) -> Path:
    """That log as a file of the test's own."""
    path = tmp_path / "run.mcap"
    path.write_bytes(short_log)
    return path
