"""Hypothesis profiles, and the runs that many tests share."""

import gc
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from . import drawn_examples  # noqa: F401 - loads a profile
from .push_set import read_long_tests


def pytest_configure(config: pytest.Config) -> None:
    """Sets the number of examples of a property: ten on a push, else a hundred."""
    if _on_a_push(config):
        settings.load_profile("push")


def _on_a_push(config: pytest.Config) -> bool:
    return "not long" in str(config.option.markexpr)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks expensive tests as long, and limits properties to ten examples on a push."""
    dear = (
        frozenset() if config.pluginmanager.hasplugin("tests.push_set") else read_long_tests()
    )
    for item in items:
        if item.nodeid in dear and not item.get_closest_marker("push"):
            item.add_marker(pytest.mark.long)
        test_settings = getattr(
            getattr(item, "function", None), "_hypothesis_internal_use_settings", None
        )
        # a test's own number precedes
        if test_settings is not None and test_settings.max_examples > 10 and _on_a_push(config):
            item.function._hypothesis_internal_use_settings = settings(
                test_settings, max_examples=10
            )


@pytest.fixture(autouse=True)
def _process_as_it_was() -> Iterator[None]:
    """Restores the process's settings, such as real-time priority and the collector, which a
    site changes.
    """
    yield
    assert gc.isenabled()


@pytest.fixture
def log_file(short_log: bytes, tmp_path: Path) -> Path:
    """Saves a short log, of the length chosen by the folder's tests, as a file of the test's own."""
    path = tmp_path / "run.mcap"
    path.write_bytes(short_log)
    return path
