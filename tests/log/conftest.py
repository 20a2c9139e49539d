"""What several tests of logs share."""

import os

import pytest

from trilat_net.log import log_file


@pytest.fixture
def unsynced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of files, of which none need survive the loss of power."""
    monkeypatch.setattr(log_file, "sync_folder", lambda _: None)
    monkeypatch.setattr(os, "fsync", lambda _: None)
