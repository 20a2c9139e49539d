"""Builds this package with the version number from the main pyproject.toml.

All packages in the repository share that version, so it is stated in one place only.
"""

import tomllib
from pathlib import Path

from setuptools import setup

STATED = Path(__file__).resolve().parents[2] / "pyproject.toml"

setup(version=tomllib.loads(STATED.read_text(encoding="utf-8"))["project"]["version"])
