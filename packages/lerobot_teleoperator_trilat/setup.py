"""Builds this package with the version number from the main pyproject.toml.

All packages of the repository share one version, which is written only there.
"""

import tomllib
from pathlib import Path

from setuptools import setup

STATED = Path(__file__).resolve().parents[2] / "pyproject.toml"

setup(version=tomllib.loads(STATED.read_text(encoding="utf-8"))["project"]["version"])
