"""States the version of the repository, in which this package has none of its own."""

import tomllib
from pathlib import Path

from setuptools import setup

STATED = Path(__file__).resolve().parents[2] / "pyproject.toml"

setup(version=tomllib.loads(STATED.read_text(encoding="utf-8"))["project"]["version"])
