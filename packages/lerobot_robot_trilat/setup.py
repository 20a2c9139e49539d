"""Builds this package with the version number of the main pyproject.toml.

All packages of the repository have the same version, which is therefore written only once.
"""

import tomllib
from pathlib import Path

from setuptools import setup

STATED = Path(__file__).resolve().parents[2] / "pyproject.toml"

setup(version=tomllib.loads(STATED.read_text(encoding="utf-8"))["project"]["version"])
