"""Deals the tests like cards, one of each module in turn: `pytest -p tests.dealt`.

Workers take tests from each other, so that a worker may leave a module after any test and come
back to it. A fixture of a module that relies on being the first to import a file, or to write a
cache, then fails, but only in some runs. Dealt tests have the fixtures of their module set up
again in a process that already had them.
"""

from collections import defaultdict

import pytest


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Runs the first test of every module, then the second of each, and so on."""
    seen: defaultdict[str, int] = defaultdict(int)
    turns: list[tuple[int, pytest.Item]] = []
    for item in items:
        module = item.nodeid.split("::")[0]
        turns.append((seen[module], item))
        seen[module] += 1
    items[:] = [item for _, item in sorted(turns, key=lambda turn: turn[0])]
