"""Fixtures that several tests of logs share."""

import os

import pytest

from trilat_net.log import log_file


@pytest.fixture
def unsynced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skips the synchronisation of files with the disk, since a test's files need not survive a loss of power."""
    monkeypatch.setattr(log_file, "sync_folder", lambda _: None)
    monkeypatch.setattr(os, "fsync", lambda _: None)
