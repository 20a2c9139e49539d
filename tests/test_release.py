"""The release: one version, workflows whose steps are existing commands, a wheel that installs and runs."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import Distribution, distribution, entry_points
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement

from tests.cli.running import parses
from trilat_net.files import STUDY_LIBRARIES
from trilat_net.net.connection import find_free_endpoints

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PINNED = re.compile(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+")
VERSION = PROJECT["project"]["version"]
RELEASE: dict[Any, Any] = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text())


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_are_pinned_and_have_few_rights(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    used = re.findall(r"uses: (.+)$", text, re.MULTILINE)
    assert used
    assert not [one for one in used if not PINNED.fullmatch(one)]
    stated = yaml.safe_load(text)
    assert stated["permissions"] == {"contents": "read"}
    for job in stated["jobs"].values():
        assert job["timeout-minutes"] <= 30
        assert all(("uses" in step) != ("run" in step) for step in job["steps"])
        for step in job["steps"]:
            if step.get("uses", "").startswith("actions/checkout@"):
                assert step["with"] == {"persist-credentials": False}
    assert "secrets." not in text


def test_workflows_install_by_hash_or_own_builds() -> None:
    """A foreign package could put its own files among the published ones."""
    installed = 0
    for path in WORKFLOWS:
        for line in re.findall(
            r"pip install (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE
        ):
            words = [word for word in line.split() if word != "--disable-pip-version-check"]
            if words[0] == "--no-index":
                assert any(word.startswith("dist") for word in words), line
            else:
                assert words[:2] == ["--require-hashes", "-r"], line
                assert len(words) == 3, line
                assert "--hash=sha256:" in (ROOT / words[2]).read_text(encoding="utf-8"), line
            installed += 1
        for line in re.findall(
            r"python -m build (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE
        ):
            # else pip gets what builds it, without hashes
            assert "--no-isolation" in line.split(), line
    assert installed >= 8


def test_commands_of_workflows_exist() -> None:
    for path in WORKFLOWS:
        for job in yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].values():
            for line in (step["run"] for step in job["steps"] if "run" in step):
                words = line.split()
                if words[0].startswith(".ci/"):
                    assert os.access(ROOT / words[0], os.X_OK), line
                elif words[0] in PROJECT["project"]["scripts"] and words[1:] != ["--version"]:
                    parses(["trilat", *words[1:]])
                else:
                    assert words[0] in (
                        "python",
                        "check-wheel-contents",
                        "twine",
                        "trilat-net",
                    ), line


def test_releases_are_built_once_without_a_secret() -> None:
    jobs = RELEASE["jobs"]
    assert RELEASE[True] == {"push": {"tags": ["v*"]}}  # YAML reads `on` so
    needs = {"build": None, "compile": "build", "install": "compile", "studies": "build"}
    assert {name: jobs[name].get("needs") for name in needs} == needs
    assert jobs["publish"]["needs"] == ["install", "studies"]
    systems = jobs["studies"]["strategy"]["matrix"]["system"]
    assert [one.partition("-")[0] for one in systems] == ["ubuntu", "macos", "windows"]
    assert jobs["publish"]["environment"]["name"] == "pypi"
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
    assert [name for name in jobs if "permissions" in jobs[name]] == ["publish"]
    assert not any("checkout" in step.get("uses", "") for step in jobs["publish"]["steps"])
    stated = [
        one.rpartition(" ")[2] for one in PROJECT["project"]["classifiers"] if ":: 3." in one
    ]
    for name in ("compile", "install"):
        assert jobs[name]["strategy"]["matrix"]["python"] == stated
    assert PROJECT["project"]["requires-python"] == f">={stated[0]}"


def names_of(stated: list[str]) -> set[str]:
    return {re.split(r"[^\w-]", one)[0] for one in stated}


def locked(name: str) -> set[str]:
    text = (ROOT / "requirements" / f"{name}.lock").read_text(encoding="utf-8")
    return set(re.findall(r"^([\w-]+)==", text, re.MULTILINE))


def test_locks_have_their_stated_contents() -> None:
    """A lock that was not made again with a new dependency lacks that dependency: `make lock`."""
    groups = {key: names_of(stated) for key, stated in PROJECT["dependency-groups"].items()}
    needed, extras = (
        PROJECT["project"]["dependencies"],
        PROJECT["project"]["optional-dependencies"],
    )
    every_extra = {name for stated in extras.values() for name in names_of(stated)}
    assert names_of(needed) | groups["build"] <= locked("runtime")
    assert not every_extra & locked("runtime")
    assert locked("runtime") | groups["dev"] | names_of(extras["frames"]) <= locked("dev")
    assert groups["docs"] <= locked("docs")
    assert groups["long"] <= locked("long")
    assert len(locked("docs")) < 40  # no environment of a developer


def check_release(tag: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, ROOT / ".ci" / "check-release", tag, folder],
        capture_output=True,
        text=True,
    )


def test_tags_must_equal_the_version(tmp_path: Path) -> None:
    for name in ("pyproject.toml", "CITATION.cff"):
        shutil.copy(ROOT / name, tmp_path)
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    (tmp_path / "CHANGELOG.md").write_text(
        changes.replace("## Unreleased", f"## {VERSION} (2026-12-01)", 1)
    )
    assert check_release(f"v{VERSION}", tmp_path).returncode == 0
    assert len(check_release("v99.0.0", tmp_path).stderr.splitlines()) == 3
    (tmp_path / "CHANGELOG.md").write_text(changes)
    refused = check_release(f"v{VERSION}", tmp_path)
    assert (refused.returncode, "CHANGELOG.md" in refused.stderr) == (
        1,
        "Unreleased" in changes,
    )


def test_both_names_of_the_program_are_one() -> None:
    """`uvx trilat-net` runs the script that bears the name of the package."""
    scripts = PROJECT["project"]["scripts"]
    assert scripts["trilat-net"] == scripts["trilat"]
    (made,) = {
        one.value for one in entry_points(group="console_scripts") if one.name == "trilat"
    }
    assert made == scripts["trilat"]


def run(*arguments: object, cwd: Path, **more: str) -> str:
    """Runs a program outside of the checkout; returns its output."""
    bare = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("PYTHON", "VIRTUAL"))
    }
    done = subprocess.run(
        [str(word) for word in arguments],
        cwd=cwd,
        env={**bare, **more},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


CORE, WHOLE = "trilat-net-core", "trilat-net"
PACKAGES = [path.parent.name for path in sorted(ROOT.glob("packages/trilat-*/pyproject.toml"))]
EXAMPLE = "trilat-lag"


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the folder from which each distribution is built."""
    folder = tmp_path_factory.mktemp("sources")
    run(sys.executable, ROOT / ".ci" / "distributions", folder / "made", cwd=folder)
    return folder / "made"


@pytest.fixture(scope="module")
def built(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    """Returns, by distribution, the sdist and the wheel that is built from the sdist."""
    build = "from setuptools.build_meta import *; import sys; print(globals()[sys.argv[1]](sys.argv[2]))"
    made = {}
    shutil.copytree(ROOT / "examples" / "package", sources / EXAMPLE)
    for name in (CORE, *PACKAGES, WHOLE, EXAMPLE):
        folder = tmp_path_factory.mktemp("built")
        run(sys.executable, "-c", build, "build_sdist", folder, cwd=sources / name)
        (sdist,) = folder.glob("*.tar.gz")
        with tarfile.open(sdist) as archive:
            archive.extractall(folder / "unpacked", filter="data")
        (unpacked,) = (folder / "unpacked").iterdir()
        run(sys.executable, "-c", build, "build_wheel", folder, cwd=unpacked)
        made[name] = [sdist, *folder.glob("*.whl")]
    return made


def test_both_distributions_are_one_program(sources: Path) -> None:
    """One has every file, the other the remaining libraries; nothing is installed twice."""
    core, whole = (
        tomllib.loads((sources / name / "pyproject.toml").read_text(encoding="utf-8"))[
            "project"
        ]
        for name in (CORE, WHOLE)
    )
    assert (core["name"], core["version"], whole["name"], whole["version"]) == (
        CORE,
        VERSION,
        WHOLE,
        VERSION,
    )
    brought = [f"{name}=={VERSION}" for name in (CORE, *PACKAGES)]
    added = whole["dependencies"][len(brought) :]
    assert whole["dependencies"][: len(brought)] == brought
    assert names_of(added) == set(STUDY_LIBRARIES)
    assert sorted([*core["dependencies"], *added]) == sorted(PROJECT["project"]["dependencies"])
    assert {**core["scripts"], **whole["scripts"]} == PROJECT["project"]["scripts"]
    assert not core["scripts"].keys() & whole["scripts"].keys()
    assert whole["optional-dependencies"] == PROJECT["project"]["optional-dependencies"]
    files = {path.name for path in (sources / WHOLE).iterdir() if path.suffix != ".egg-info"}
    assert files == {"pyproject.toml", "README.md", "LICENSE"}


@pytest.mark.parametrize("name", PACKAGES)
def test_packages_have_the_programs_version_bounds(name: str, sources: Path) -> None:
    released = tomllib.loads((sources / name / "pyproject.toml").read_text(encoding="utf-8"))
    first, *libraries = released["project"]["dependencies"]
    assert (released["project"]["version"], first) == (VERSION, f"{CORE}=={VERSION}")
    assert "dynamic" not in released["project"]
    assert set(libraries) <= set(PROJECT["project"]["dependencies"])
    assert distribution(name).version == VERSION


def needed(names: set[str]) -> dict[str, Distribution]:
    """Returns these distributions of this environment, and all their dependencies."""
    found: dict[str, Distribution] = {}
    left = set(names)
    while left:
        one = found[name] = distribution(name := left.pop())
        stated = map(Requirement, one.requires or [])
        left |= {
            r.name for r in stated if not r.marker or r.marker.evaluate({"extra": ""})
        } - found.keys()
    return found


def install(clean: Path, wheel: Path, libraries: set[str]) -> Path:
    """Installs a wheel into an environment, and libraries from this one; returns its `site-packages`."""
    onto = [
        "-m",
        "pip",
        "--python",
        clean / "bin" / "python",
        "install",
        "--no-deps",
        "--no-index",
        wheel,
    ]
    run(sys.executable, *onto, cwd=clean)
    (packages,) = (clean / "lib").glob("python3*/site-packages")
    for one in needed(libraries).values():
        for top in {
            file.parts[0]
            for file in one.files or []
            if file.parts[0] not in ("..", "__pycache__")
        }:
            (packages / top).exists() or (packages / top).symlink_to(one.locate_file(top))
    return packages


@pytest.mark.live
@pytest.mark.long
def test_a_robot_runs_trilat_net_core_alone(
    built: dict[str, list[Path]], tmp_path: Path
) -> None:
    """Without a network: libraries are of this environment, the program is the wheel's; then
    both wheels'.
    """
    with zipfile.ZipFile(built[CORE][1]) as archive:
        names = set(archive.namelist())
    packages = ("trilat_net", "sites", "recorder", "live")
    code = {
        str(one.relative_to(ROOT)) for name in packages for one in (ROOT / name).rglob("*.py")
    }
    assert code <= names
    assert {name.split("/")[0] for name in names if "." not in name.split("/")[0]} == set(
        packages
    )
    clean = tmp_path / "clean"
    run(sys.executable, "-m", "venv", "--without-pip", clean, cwd=tmp_path)
    stated = names_of(PROJECT["project"]["dependencies"])
    where = install(clean, built[CORE][1], stated - set(STUDY_LIBRARIES))
    heavy = "matplotlib", "scipy", "loky", "pandas", "polars", "pydantic"
    assert not [name for name in heavy if (where / name).exists()]
    trilat = clean / "bin" / "trilat"
    run(trilat, "keys", "new", "keys", "m", "s", "recorder", cwd=tmp_path)
    run(trilat, "sim", "two_sites", "--duration", "1", "-o", "first.mcap", cwd=tmp_path)
    run(trilat, "verify", "first.mcap", cwd=tmp_path)  # compiled before three at once would
    ends = [one.replace("tcp", "tls", 1) for one in find_free_endpoints(3)]
    ways = [
        ["--listen", own, *(f"--connect={one}" for one in ends[:n])]
        for n, own in enumerate(ends)
    ]
    members = [
        ["site", name, "--scenario", "two_sites", "--set", "duration_s=2"]
        for name in ("m", "s")
    ]
    members.append(["record", "-o", "run.mcap"])
    started = [
        subprocess.Popen(
            [trilat, *words, "--session", "t", "--keys", f"keys/{name}", *way], cwd=tmp_path
        )
        for words, way, name in zip(members, ways, ("m", "s", "recorder"), strict=True)
    ]
    try:
        assert [process.wait(timeout=300) for process in started] == [0, 0, 0]
    finally:
        for process in started:
            process.kill()
    assert "4000/4000 records identical" in run(trilat, "verify", "run.mcap", cwd=tmp_path)
    for name in PACKAGES:
        install(clean, built[name][1], stated)
    install(clean, built[WHOLE][1], stated)
    for name in PROJECT["project"]["scripts"]:
        assert run(clean / "bin" / name, "--version", cwd=tmp_path) == f"trilat-net {VERSION}\n"
    run(clean / "bin" / "trilat-net", "report", "run.mcap", "-o", "report", cwd=tmp_path)
    assert (tmp_path / "report" / "report.html").is_file()


ALONE = """
import sys
import trilat_net as tn
print(tn.simulate("two_sites", duration_s=0.1)["m"].q.shape)
import recorder.record_process, sites.site_process, trilat_net.app.doctor
from trilat_net.errors import UsageError
try:
    tn.sweep("two_sites")
except UsageError as error:
    print(error)
print([name for name in sys.modules if name.startswith("trilat_studies")])
"""


@pytest.mark.long
def test_own_and_foreign_packages_join_the_core(
    built: dict[str, list[Path]], tmp_path: Path
) -> None:
    """The core imports none of them, and names the installation; with them it has their
    commands and functions.
    """
    clean = tmp_path / "clean"
    run(sys.executable, "-m", "venv", "--without-pip", clean, cwd=tmp_path)
    stated = names_of(PROJECT["project"]["dependencies"])
    install(clean, built[CORE][1], stated - set(STUDY_LIBRARIES))
    python, trilat = clean / "bin" / "python", clean / "bin" / "trilat"
    printed = run(python, "-c", ALONE, cwd=tmp_path).splitlines()
    assert printed[-3] == "(100, 2)"
    assert "pip install trilat-studies" in printed[-2]
    assert printed[-1] == "[]"
    refused = subprocess.run([trilat, "sweep", "two_sites"], capture_output=True, text=True)
    assert refused.returncode == 2
    assert refused.stderr.splitlines() == [
        "error: trilat sweep is in a package of its own: pip install trilat-studies"
    ]
    install(clean, built[EXAMPLE][1], set())
    assert "lag " in run(trilat, "--help", cwd=tmp_path)
    words = ("lag", "two_sites", "--seeds", "2", "--duration", "0.1")
    assert len(run(trilat, *words, cwd=tmp_path).splitlines()) == 2
    called = "import trilat_net as tn; print(len(tn.measure_lags('two_sites', 2, 0.1)))"
    assert run(python, "-c", called, cwd=tmp_path) == "2\n"
    install(clean, built["trilat-studies"][1], stated)
    grid = ("--over", "link.delay_ms=0,100", "--duration", "0.5", "--jobs", "1", "-o", "grid")
    run(trilat, "sweep", "two_sites", *grid, cwd=tmp_path)
    assert (tmp_path / "grid" / "results.csv").is_file()


@pytest.mark.long
def test_the_packagers_find_nothing(built: dict[str, list[Path]]) -> None:
    tools = {name: shutil.which(name) for name in ("check-wheel-contents", "twine")}
    if missing := [name for name, path in tools.items() if path is None]:
        pytest.skip(f"there is no {', '.join(missing)} here; the release workflow has them")
    run(tools["check-wheel-contents"], built[CORE][1], cwd=ROOT)
    run(tools["twine"], "check", "--strict", *built[CORE], *built[WHOLE], cwd=ROOT)


def test_importing_the_package_imports_nothing_slow() -> None:
    """The bound is 30 ms: beyond an interpreter's start the import needs only a few modules of
    the library.
    """
    code = "import sys; before = set(sys.modules); import trilat_net; print(*(set(sys.modules) - before))"
    made = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    )
    extra = {name.partition(".")[0] for name in made.stdout.split()} - {"trilat_net"}
    assert extra <= sys.stdlib_module_names
    assert len(made.stdout.split()) < 60
