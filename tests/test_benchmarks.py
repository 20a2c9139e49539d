"""Benchmarks are run by hand; a missing import is found by this test."""

from importlib import import_module
from pathlib import Path

import pytest

NAMES = sorted(
    path.stem for path in (Path(__file__).parents[1] / "benchmarks").glob("[!_]*.py")
)


@pytest.mark.parametrize("name", NAMES)
def test_benchmarks_find_their_measured_functions(name: str) -> None:
    assert import_module(f"benchmarks.{name}").__doc__
