"""Hypothesis profiles, and the runs that many tests look at."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from .push_set import read_long_tests

settings.register_profile("desk", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", settings.get_profile("desk"), derandomize=True, print_blob=True)
settings.register_profile("push", settings.get_profile("ci"), max_examples=10)
settings.load_profile("ci" if os.environ.get("CI") else "desk")


def pytest_configure(config: pytest.Config) -> None:
    """On a push a property is tried with ten examples, else with a hundred."""
    if _on_a_push(config):
        settings.load_profile("push")


def _on_a_push(config: pytest.Config) -> bool:
    return "not long" in str(config.option.markexpr)


OTHER_LAYOUTS = {"seven_joints", "unlike_arms"}
"""Scenarios for which the core is compiled anew: their runs are long tests."""


LIKE_OTHERS = {
    "asymmetric",
    "box",
    "force_sharing",
    "jitter",
    "lyapunov",
    "p_d_margin_two",
    "paper_rods",
    "windup",
}
"""Scenarios beside which another one runs nearly the same: what all must pass, these pass in long tests."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks tests that run such a scenario or are dear; on a push, a property has ten examples at most."""
    dear = frozenset() if config.pluginmanager.hasplugin("tests.push_set") else read_long_tests()
    for item in items:
        if item.nodeid in dear and not item.get_closest_marker("push"):
            item.add_marker(pytest.mark.long)
        own = getattr(getattr(item, "function", None), "_hypothesis_internal_use_settings", None)
        if own is not None and own.max_examples > 10 and _on_a_push(config):  # a test's own number precedes
            item.function._hypothesis_internal_use_settings = settings(own, max_examples=10)
        values = item.callspec.params.values() if hasattr(item, "callspec") else ()
        runs = {"execution", "log", "golden"} & set(item.path.parts)
        if runs and (OTHER_LAYOUTS | LIKE_OTHERS).intersection(one for one in values if isinstance(one, str)):
            item.add_marker(pytest.mark.long)


@pytest.fixture
def log_file(short_log: bytes, tmp_path: Path) -> Path:
    """A short log, as long as the folder's tests want it, as a file of the test's own."""
    path = tmp_path / "run.mcap"
    path.write_bytes(short_log)
    return path
