"""The release: one version, workflows whose steps are commands that exist, a wheel that installs and runs."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import distribution, entry_points
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.cli.running import assert_parses
from tests.distributions import (
    CORE,
    OF_PACKAGES,
    PACKAGES,
    WHOLE,
    build_distributions,
    install_wheel,
    list_requirement_names,
    make_sources,
    run_outside,
)
from tests.net.free_endpoints import find_free_endpoints

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
    assert not [action for action in used if not PINNED.fullmatch(action)]
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
    """A package of somebody else could put its own files among those that are published."""
    installed = 0
    for path in WORKFLOWS:
        for line in re.findall(
            r"pip install (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE
        ):
            options = [word for word in line.split() if word != "--disable-pip-version-check"]
            if options[0] == "--no-index":
                assert any(word.startswith("dist") for word in options), line
            else:
                assert options[:2] == ["--require-hashes", "-r"], line
                assert len(options) == 3, line
                assert "--hash=sha256:" in (ROOT / options[2]).read_text(encoding="utf-8"), line
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
                command = line.split()
                if command[0].startswith(".ci/"):
                    assert os.access(ROOT / command[0], os.X_OK), line
                elif command[0] in PROJECT["project"]["scripts"] and command[1:] != [
                    "--version"
                ]:
                    assert_parses(["trilat", *command[1:]])
                else:
                    assert command[0] in (
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
    assert [system.partition("-")[0] for system in systems] == ["ubuntu", "macos", "windows"]
    assert jobs["publish"]["environment"]["name"] == "pypi"
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
    assert [name for name in jobs if "permissions" in jobs[name]] == ["publish"]
    assert not any("checkout" in step.get("uses", "") for step in jobs["publish"]["steps"])
    stated = [
        classifier.rpartition(" ")[2]
        for classifier in PROJECT["project"]["classifiers"]
        if ":: 3." in classifier
    ]
    for name in ("compile", "install"):
        assert jobs[name]["strategy"]["matrix"]["python"] == stated
    assert PROJECT["project"]["requires-python"] == f">={stated[0]}"


def list_locked(name: str) -> set[str]:
    text = (ROOT / "requirements" / f"{name}.lock").read_text(encoding="utf-8")
    return set(re.findall(r"^([\w-]+)==", text, re.MULTILINE))


def test_locks_have_their_stated_contents() -> None:
    """A lock that is made once and not again with a new dependency lacks it: `make lock`."""
    groups = {
        key: list_requirement_names(stated)
        for key, stated in PROJECT["dependency-groups"].items()
    }
    needed = PROJECT["project"]["dependencies"]
    extras = PROJECT["project"]["optional-dependencies"]
    every_extra = {
        name for stated in extras.values() for name in list_requirement_names(stated)
    }
    assert list_requirement_names(needed) | groups["build"] <= list_locked("runtime")
    assert not every_extra & list_locked("runtime")
    assert list_locked("runtime") | groups["dev"] | list_requirement_names(
        extras["frames"]
    ) <= list_locked("dev")
    assert groups["docs"] <= list_locked("docs")
    assert groups["long"] <= list_locked("long")
    assert len(list_locked("docs")) < 40  # no environment of a developer


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
    (target,) = {
        entry.value for entry in entry_points(group="console_scripts") if entry.name == "trilat"
    }
    assert target == scripts["trilat"]


EXAMPLE = "trilat-lag"


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of what each distribution is built from."""
    folder = tmp_path_factory.mktemp("sources")
    return make_sources(folder / "made")


@pytest.fixture(scope="module")
def built(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    """Returns the sdist of each distribution, and the wheel that is built from the sdist."""
    wheels = {}
    shutil.copytree(ROOT / "examples" / "package", sources / EXAMPLE)
    for name in (CORE, *PACKAGES, WHOLE, EXAMPLE):
        wheels[name] = build_distributions(sources / name, tmp_path_factory.mktemp("built"))
    return wheels


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
    assert list_requirement_names(added) == OF_PACKAGES
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
    of_tests = released.get("dependency-groups", {}).get("test", [])
    assert list_requirement_names(of_tests) <= list_locked("dev")
    assert distribution(name).version == VERSION


@pytest.mark.live
@pytest.mark.long
def test_a_robot_runs_trilat_net_core_alone(
    built: dict[str, list[Path]], tmp_path: Path
) -> None:
    """Without a network, libraries come from this environment, and the program from its wheel, then from both wheels."""
    with zipfile.ZipFile(built[CORE][1]) as archive:
        names = set(archive.namelist())
    packages = ("trilat_net", "sites", "recorder")
    code = {
        str(path.relative_to(ROOT)) for name in packages for path in (ROOT / name).rglob("*.py")
    }
    assert code <= names
    assert {name.split("/")[0] for name in names if "." not in name.split("/")[0]} == set(
        packages
    )
    clean = tmp_path / "clean"
    run_outside(sys.executable, "-m", "venv", "--without-pip", clean, cwd=tmp_path)
    stated = list_requirement_names(PROJECT["project"]["dependencies"])
    where = install_wheel(clean, built[CORE][1], stated - OF_PACKAGES)
    heavy = *OF_PACKAGES, "pandas", "polars", "pydantic"
    assert not [name for name in heavy if (where / name).exists()]
    trilat = clean / "bin" / "trilat"
    run_outside(trilat, "keys", "new", "keys", "m", "s", "recorder", cwd=tmp_path)
    run_outside(trilat, "sim", "two_sites", "--duration", "1", "-o", "first.mcap", cwd=tmp_path)
    run_outside(
        trilat, "verify", "first.mcap", cwd=tmp_path
    )  # compiled before three at once would
    ends = [endpoint.replace("tcp", "tls", 1) for endpoint in find_free_endpoints(3)]
    ways = [
        ["--listen", listening, *(f"--connect={endpoint}" for endpoint in ends[:n])]
        for n, listening in enumerate(ends)
    ]
    members = [
        ["site", name, "--scenario", "two_sites", "--set", "duration_s=2"]
        for name in ("m", "s")
    ]
    members.append(["record", "-o", "run.mcap"])
    started = [
        subprocess.Popen(
            [trilat, *command, "--session", "t", "--keys", f"keys/{name}", *way], cwd=tmp_path
        )
        for command, way, name in zip(members, ways, ("m", "s", "recorder"), strict=True)
    ]
    try:
        assert [process.wait(timeout=300) for process in started] == [0, 0, 0]
    finally:
        for process in started:
            process.kill()
    assert "4000/4000 records identical" in run_outside(
        trilat, "verify", "run.mcap", cwd=tmp_path
    )
    for name in PACKAGES:
        install_wheel(clean, built[name][1], stated)
    install_wheel(clean, built[WHOLE][1], stated)
    for name in PROJECT["project"]["scripts"]:
        assert (
            run_outside(clean / "bin" / name, "--version", cwd=tmp_path)
            == f"trilat-net {VERSION}\n"
        )
    run_outside(
        clean / "bin" / "trilat-net", "report", "run.mcap", "-o", "report", cwd=tmp_path
    )
    assert (tmp_path / "report" / "report.html").is_file()


ALONE = """
import sys
import trilat_net as tn
print(tn.simulate("two_sites", duration_s=0.1)["m"].q.shape)
import recorder.record_process, sites.site_process, trilat_net.app.doctor
from trilat_net.errors import UsageError
for use in (tn.sweep, tn.run_experiment, tn.SpaceMouse):
    try:
        use("two_sites")
    except UsageError as error:
        print(error)
packages = ("trilat_people", "trilat_ros2", "trilat_studies", "websockets")
print([name for name in sys.modules if name.partition(".")[0] in packages])
"""


MISSING = {
    "sweep": "trilat-studies",
    "live": "trilat-people",
    "hand": "trilat-people",
    "experiment run": "trilat-people",
    "ros2": "trilat-ros2",
}
"""Commands that the core lacks, and the packages that they are in."""


@pytest.mark.long
def test_own_and_foreign_packages_join_the_core(
    built: dict[str, list[Path]], tmp_path: Path
) -> None:
    """The core imports none of them, and says what to install; with them it has their commands and functions."""
    clean = tmp_path / "clean"
    run_outside(sys.executable, "-m", "venv", "--without-pip", clean, cwd=tmp_path)
    stated = list_requirement_names(PROJECT["project"]["dependencies"])
    install_wheel(clean, built[CORE][1], stated - OF_PACKAGES)
    python = clean / "bin" / "python"
    trilat = clean / "bin" / "trilat"
    printed = run_outside(python, "-c", ALONE, cwd=tmp_path).splitlines()
    assert printed[-5] == "(100, 2)"
    assert "pip install trilat-studies" in printed[-4]
    assert "pip install trilat-people" in printed[-3]
    assert "pip install trilat-people" in printed[-2]
    assert printed[-1] == "[]"
    for command, package in MISSING.items():
        arguments = command.split()
        refused = subprocess.run(
            [trilat, *arguments, "two_sites"], capture_output=True, text=True
        )
        assert refused.returncode == 2
        assert refused.stderr.splitlines() == [
            f"error: trilat {command} is in a separate package: pip install {package}"
        ]
    install_wheel(clean, built[EXAMPLE][1], set())
    assert "lag " in run_outside(trilat, "--help", cwd=tmp_path)
    arguments = ("lag", "two_sites", "--seeds", "2", "--duration", "0.1")
    assert len(run_outside(trilat, *arguments, cwd=tmp_path).splitlines()) == 2
    called = "import trilat_net as tn; print(len(tn.measure_lags('two_sites', 2, 0.1)))"
    assert run_outside(python, "-c", called, cwd=tmp_path) == "2\n"
    run_outside(
        trilat, "sim", "two_sites", "--duration", "2", "-o", "lagging.mcap", cwd=tmp_path
    )
    lines = run_outside(
        trilat, "log", "view", "lagging.mcap", "--in", "lag", cwd=tmp_path
    ).splitlines()
    assert [line.partition(":")[0] for line in lines] == [
        "m, 0 s",
        "m, 1 s",
        "s, 0 s",
        "s, 1 s",
    ]
    install_wheel(clean, built["trilat-studies"][1], stated)
    grid = ("--over", "link.delay_ms=0,100", "--duration", "0.5", "--jobs", "1", "-o", "grid")
    run_outside(trilat, "sweep", "two_sites", *grid, cwd=tmp_path)
    assert (tmp_path / "grid" / "results.csv").is_file()
    install_wheel(clean, built["trilat-people"][1], stated)
    run_outside(trilat, "experiment", "new", "reach.toml", cwd=tmp_path)
    assert "trials" in run_outside(trilat, "experiment", "check", "reach.toml", cwd=tmp_path)
    page = "import trilat_people.live_page.page_files as p; print(*sorted(p._list_assets()))"
    assert "/three.module.min.js" in run_outside(python, "-c", page, cwd=tmp_path).split()


def test_the_page_of_installation_names_every_package() -> None:
    """`pip install .` alone would leave out the packages that lie in a folder of their own."""
    text = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    lines = re.findall(r"^python -m pip install --no-deps (.*)$", text, re.MULTILINE)
    installed = " ".join(lines).split()
    assert installed == [".", *(f"./packages/{name}" for name in PACKAGES)]


@pytest.mark.long
def test_the_packagers_find_nothing(built: dict[str, list[Path]]) -> None:
    tools = {name: shutil.which(name) for name in ("check-wheel-contents", "twine")}
    if missing := [name for name, path in tools.items() if path is None]:
        pytest.skip(f"there is no {', '.join(missing)} here; the release workflow has them")
    run_outside(tools["check-wheel-contents"], built[CORE][1], cwd=ROOT)
    run_outside(tools["twine"], "check", "--strict", *built[CORE], *built[WHOLE], cwd=ROOT)


def test_importing_the_package_imports_nothing_slow() -> None:
    """The bar is 30 ms: what it imports beyond an interpreter's start are a few modules of the library."""
    code = "import sys; before = set(sys.modules); import trilat_net; print(*(set(sys.modules) - before))"
    process = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    )
    extra = {name.partition(".")[0] for name in process.stdout.split()} - {"trilat_net"}
    assert extra <= sys.stdlib_module_names
    assert len(process.stdout.split()) < 60
