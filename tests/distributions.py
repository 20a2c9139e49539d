"""The distributions of this repository: their sources, their wheels, and environments that have some of them."""

import os
import re
import subprocess
import sys
import tarfile
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

from trilat_net.files import STUDY_LIBRARIES

ROOT = Path(__file__).parents[1]
CORE, WHOLE = "trilat-net-core", "trilat-net"
OF_PACKAGES = {*STUDY_LIBRARIES, "websockets"}
"""Libraries that only the packages beside the core need."""
PACKAGES = [path.parent.name for path in sorted(ROOT.glob("packages/trilat-*/pyproject.toml"))]


def names_of(stated: list[str]) -> set[str]:
    return {re.split(r"[^\w-]", one)[0] for one in stated}


def bare_environment() -> dict[str, str]:
    """The environment variables of this process, but none by which another Python would find its packages."""
    names = (name for name in os.environ if not name.startswith(("PYTHON", "VIRTUAL")))
    return {name: os.environ[name] for name in names}


def run_program(*words: object, cwd: Path, **more: str) -> str:
    """Runs a program outside of the checkout; returns what it printed."""
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env={**bare_environment(), **more},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def make_sources(folder: Path) -> Path:
    """Makes the sources of all distributions in a folder, each in a folder of its own."""
    run_program(sys.executable, ROOT / ".ci" / "distributions", folder, cwd=folder.parent)
    return folder


def build_distributions(source: Path, folder: Path) -> list[Path]:
    """Builds a distribution: its sdist, and the wheel that is made of that sdist."""
    code = "from setuptools.build_meta import *; import sys; print(globals()[sys.argv[1]](sys.argv[2]))"
    run_program(sys.executable, "-c", code, "build_sdist", folder, cwd=source)
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    run_program(sys.executable, "-c", code, "build_wheel", folder, cwd=unpacked)
    return [sdist, *folder.glob("*.whl")]


def needed(names: set[str]) -> dict[str, Distribution]:
    """These distributions of this environment, and all that they need."""
    found: dict[str, Distribution] = {}
    left = set(names)
    while left:
        one = found[name] = distribution(name := left.pop())
        stated = map(Requirement, one.requires or [])
        left |= {
            r.name for r in stated if not r.marker or r.marker.evaluate({"extra": ""})
        } - found.keys()
    return found


def install(clean: Path, wheel: Path | None, libraries: set[str]) -> Path:
    """Installs a wheel into an environment, and libraries from this one; returns its `site-packages`."""
    if wheel is not None:
        onto = [
            "--python",
            clean / "bin" / "python",
            "install",
            "--no-deps",
            "--no-index",
            wheel,
        ]
        run_program(sys.executable, "-m", "pip", *onto, cwd=clean)
    (packages,) = (clean / "lib").glob("python3*/site-packages")
    for one in needed(libraries).values():
        for top in {
            file.parts[0]
            for file in one.files or []
            if file.parts[0] not in ("..", "__pycache__")
        }:
            (packages / top).exists() or (packages / top).symlink_to(one.locate_file(top))
    return packages
