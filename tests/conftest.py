"""Hypothesis profiles, and the runs that many tests look at."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile("desk", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", settings.get_profile("desk"), derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "desk")


@pytest.fixture
def log_file(short_log: bytes, tmp_path: Path) -> Path:
    """A short log, as long as the folder's tests want it, as a file of the test's own."""
    path = tmp_path / "run.mcap"
    path.write_bytes(short_log)
    return path
