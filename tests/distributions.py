"""The distributions of this repository: their sources, their wheels, and environments that have some of them."""

import os
import re
import sys
import tarfile
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

from tests.programs import run_program
from trilat_net.package_names import STUDY_LIBRARIES

ROOT = Path(__file__).parents[1]
CORE = "trilat-net-core"
WHOLE = "trilat-net"
OF_PACKAGES = {*STUDY_LIBRARIES, "websockets"}
"""Libraries that only the packages beside the core need."""
PACKAGES = [path.parent.name for path in sorted(ROOT.glob("packages/trilat-*/pyproject.toml"))]


def list_requirement_names(stated: list[str]) -> set[str]:
    return {re.split(r"[^\w-]", requirement)[0] for requirement in stated}


def bare_environment() -> dict[str, str]:
    """Returns the environment variables of this process without those by which another Python finds packages."""
    names = (name for name in os.environ if not name.startswith(("PYTHON", "VIRTUAL")))
    return {name: os.environ[name] for name in names}


def run_outside(*command: object, cwd: Path, **more: str) -> str:
    """Returns the output of a program that runs outside of the checkout and must succeed."""
    environment = {**bare_environment(), **more}
    return run_program(*command, cwd=cwd, environment=environment, timeout_s=None)


def make_sources(folder: Path) -> Path:
    """Writes the sources of each distribution into a subfolder."""
    run_outside(sys.executable, ROOT / ".ci" / "distributions", folder, cwd=folder.parent)
    return folder


def build_distributions(source: Path, folder: Path) -> list[Path]:
    """Builds the sdist of a distribution, and the wheel from that sdist."""
    code = "from setuptools.build_meta import *; import sys; print(globals()[sys.argv[1]](sys.argv[2]))"
    run_outside(sys.executable, "-c", code, "build_sdist", folder, cwd=source)
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    run_outside(sys.executable, "-c", code, "build_wheel", folder, cwd=unpacked)
    return [sdist, *folder.glob("*.whl")]


def find_needed(names: set[str]) -> dict[str, Distribution]:
    """Returns distributions of this environment with everything that they need, by name."""
    distributions: dict[str, Distribution] = {}
    left = set(names)
    while left:
        library = distributions[name] = distribution(name := left.pop())
        stated = map(Requirement, library.requires or [])
        left |= {
            r.name for r in stated if not r.marker or r.marker.evaluate({"extra": ""})
        } - distributions.keys()
    return distributions


def install_wheel(clean: Path, wheel: Path | None, libraries: set[str]) -> Path:
    """Installs a wheel and libraries of this environment into another one, and returns the `site-packages` there."""
    if wheel is not None:
        onto = [
            "--python",
            clean / "bin" / "python",
            "install",
            "--no-deps",
            "--no-index",
            wheel,
        ]
        run_outside(sys.executable, "-m", "pip", *onto, cwd=clean)
    (packages,) = (clean / "lib").glob("python3*/site-packages")
    for library in find_needed(libraries).values():
        for top in {
            file.parts[0]
            for file in library.files or []
            if file.parts[0] not in ("..", "__pycache__")
        }:
            (packages / top).exists() or (packages / top).symlink_to(library.locate_file(top))
    return packages
