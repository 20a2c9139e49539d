"""Benchmarks are run by hand; a missing import is found by this test."""

from importlib import import_module
from pathlib import Path

import pytest

NAMES = sorted(
    path.stem for path in (Path(__file__).parents[1] / "benchmarks").glob("[!_]*.py")
)


@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_finds_what_it_measures(name: str) -> None:
    assert import_module(f"benchmarks.{name}").__doc__
