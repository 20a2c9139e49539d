"""Runs the quick tests of each package where only the core and the package itself are installed.

    python -m tests.each_package [NAME ...]

Each package gets an environment of its own. The core and the package are installed there from wheels that are
built of this clone. The libraries that the two require, those of the package's dependency group `test`, and those
of `TEST_LIBRARIES`, are the locked ones of the environment that runs this, so that no network is needed. The tests run in a folder that has no source of the
program: what they import is what is installed.
"""

import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from tests.distributions import (
    build_distributions,
    install_wheel,
    list_requirement_names,
    run_outside,
)

from .distributions import CORE, PACKAGES, ROOT, bare_environment, make_sources

TEST_LIBRARIES = {"hypothesis", "playwright", "pytest", "pytest-timeout", "pytest-xdist"}
"""The packages of the dependency group `dev` that the tests of every package need."""
FOUND = """
from importlib.util import find_spec
print(*(name for name in {names} if find_spec(name) is not None))
print(find_spec("trilat_net").origin)
"""
SOURCES = {"packages", "recorder", "sites", "trilat_net"}
"""Top-level folders that are hidden from the tests."""


def make_environment(name: str, sources: Path, folder: Path) -> Path:
    """Creates an environment with the core, one package and the libraries of tests, and returns its folder."""
    clean = folder / "clean"
    run_outside(sys.executable, "-m", "venv", "--without-pip", clean, cwd=folder)
    for distribution in (CORE, name):
        built = folder / distribution
        built.mkdir()
        stated = tomllib.loads(
            (sources / distribution / "pyproject.toml").read_text(encoding="utf-8")
        )
        libraries = list_requirement_names(stated["project"]["dependencies"]) - {CORE}
        install_wheel(clean, build_distributions(sources / distribution, built)[1], libraries)
    of_tests = stated.get("dependency-groups", {}).get("test", [])
    install_wheel(clean, None, TEST_LIBRARIES | list_requirement_names(of_tests))
    return clean


def make_tree(name: str, folder: Path) -> Path:
    """Creates a folder that looks like this clone to the tests of one package, but contains no sources."""
    tree = folder / "tree"
    tests = tree / "packages" / name / "tests"
    tests.parent.mkdir(parents=True)
    tests.symlink_to(ROOT / "packages" / name / "tests")
    listed = run_outside("git", "ls-tree", "--name-only", "HEAD", cwd=ROOT).split()
    for top in set(listed) - SOURCES:
        (tree / top).symlink_to(ROOT / top)
    return tree


def run_tests(name: str, sources: Path) -> int:
    """Runs the quick tests of a package; returns the exit code of pytest."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        clean = make_environment(name, sources, folder)
        tree = make_tree(name, folder)
        modules = [package.replace("-", "_") for package in PACKAGES]
        code = FOUND.format(names=modules)
        imported, origin = run_outside(
            clean / "bin" / "python", "-c", code, cwd=tree
        ).splitlines()
        assert imported == name.replace("-", "_"), imported
        assert Path(origin).is_relative_to(clean), origin
        tests = f"packages/{name}/tests"
        settings = [
            "-o",
            f"pythonpath={tests}",
            "-p",
            "no:cacheprovider",
            "-p",
            "tests.conftest",
        ]
        options = ["-q", "-n", "auto", *settings, "-m", "not live and not long", tests]
        return subprocess.run(
            [clean / "bin" / "python", "-m", "pytest", *options],
            cwd=tree,
            env=bare_environment(),
        ).returncode


def main() -> None:
    """Runs the tests of the packages that the command line names, or of all."""
    names = sys.argv[1:] or PACKAGES
    with tempfile.TemporaryDirectory() as folder:
        sources = make_sources(Path(folder) / "sources")
        failed = [name for name in names if run_tests(name, sources)]
    print("all pass alone" if not failed else f"these fail alone: {', '.join(failed)}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
