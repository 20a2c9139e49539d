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
    install,
    make_sources,
    names_of,
    run_program,
)
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
    """A package of somebody else could put its own files among those that are published."""
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
                    assert_parses(["trilat", *words[1:]])
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


def locked(name: str) -> set[str]:
    text = (ROOT / "requirements" / f"{name}.lock").read_text(encoding="utf-8")
    return set(re.findall(r"^([\w-]+)==", text, re.MULTILINE))


def test_locks_have_their_stated_contents() -> None:
    """A lock that is made once and not again with a new dependency lacks it: `make lock`."""
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


EXAMPLE = "trilat-lag"


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of what each distribution is built from."""
    folder = tmp_path_factory.mktemp("sources")
    return make_sources(folder / "made")


@pytest.fixture(scope="module")
def built(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    """By distribution its sdist, and the wheel that is made of that sdist."""
    made = {}
    shutil.copytree(ROOT / "examples" / "package", sources / EXAMPLE)
    for name in (CORE, *PACKAGES, WHOLE, EXAMPLE):
        made[name] = build_distributions(sources / name, tmp_path_factory.mktemp("built"))
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
    assert names_of(added) == OF_PACKAGES
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
    assert names_of(of_tests) <= locked("dev")
    assert distribution(name).version == VERSION


@pytest.mark.live
@pytest.mark.long
def test_a_robot_runs_trilat_net_core_alone(
    built: dict[str, list[Path]], tmp_path: Path
) -> None:
    """Without a network: libraries are of this environment, the program is the wheel's; then both wheels'."""
    with zipfile.ZipFile(built[CORE][1]) as archive:
        names = set(archive.namelist())
    packages = ("trilat_net", "sites", "recorder")
    code = {
        str(one.relative_to(ROOT)) for name in packages for one in (ROOT / name).rglob("*.py")
    }
    assert code <= names
    assert {name.split("/")[0] for name in names if "." not in name.split("/")[0]} == set(
        packages
    )
    clean = tmp_path / "clean"
    run_program(sys.executable, "-m", "venv", "--without-pip", clean, cwd=tmp_path)
    stated = names_of(PROJECT["project"]["dependencies"])
    where = install(clean, built[CORE][1], stated - OF_PACKAGES)
    heavy = *OF_PACKAGES, "pandas", "polars", "pydantic"
    assert not [name for name in heavy if (where / name).exists()]
    trilat = clean / "bin" / "trilat"
    run_program(trilat, "keys", "new", "keys", "m", "s", "recorder", cwd=tmp_path)
    run_program(trilat, "sim", "two_sites", "--duration", "1", "-o", "first.mcap", cwd=tmp_path)
    run_program(
        trilat, "verify", "first.mcap", cwd=tmp_path
    )  # compiled before three at once would
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
    assert "4000/4000 records identical" in run_program(
        trilat, "verify", "run.mcap", cwd=tmp_path
    )
    for name in PACKAGES:
        install(clean, built[name][1], stated)
    install(clean, built[WHOLE][1], stated)
    for name in PROJECT["project"]["scripts"]:
        assert (
            run_program(clean / "bin" / name, "--version", cwd=tmp_path)
            == f"trilat-net {VERSION}\n"
        )
    run_program(
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
    run_program(sys.executable, "-m", "venv", "--without-pip", clean, cwd=tmp_path)
    stated = names_of(PROJECT["project"]["dependencies"])
    install(clean, built[CORE][1], stated - OF_PACKAGES)
    python, trilat = clean / "bin" / "python", clean / "bin" / "trilat"
    printed = run_program(python, "-c", ALONE, cwd=tmp_path).splitlines()
    assert printed[-5] == "(100, 2)"
    assert "pip install trilat-studies" in printed[-4]
    assert "pip install trilat-people" in printed[-3]
    assert "pip install trilat-people" in printed[-2]
    assert printed[-1] == "[]"
    for command, package in MISSING.items():
        words = command.split()
        refused = subprocess.run([trilat, *words, "two_sites"], capture_output=True, text=True)
        assert refused.returncode == 2
        assert refused.stderr.splitlines() == [
            f"error: trilat {command} is in a package of its own: pip install {package}"
        ]
    install(clean, built[EXAMPLE][1], set())
    assert "lag " in run_program(trilat, "--help", cwd=tmp_path)
    words = ("lag", "two_sites", "--seeds", "2", "--duration", "0.1")
    assert len(run_program(trilat, *words, cwd=tmp_path).splitlines()) == 2
    called = "import trilat_net as tn; print(len(tn.measure_lags('two_sites', 2, 0.1)))"
    assert run_program(python, "-c", called, cwd=tmp_path) == "2\n"
    run_program(
        trilat, "sim", "two_sites", "--duration", "2", "-o", "lagging.mcap", cwd=tmp_path
    )
    lines = run_program(
        trilat, "log", "view", "lagging.mcap", "--in", "lag", cwd=tmp_path
    ).splitlines()
    assert [line.partition(":")[0] for line in lines] == [
        "m, 0 s",
        "m, 1 s",
        "s, 0 s",
        "s, 1 s",
    ]
    install(clean, built["trilat-studies"][1], stated)
    grid = ("--over", "link.delay_ms=0,100", "--duration", "0.5", "--jobs", "1", "-o", "grid")
    run_program(trilat, "sweep", "two_sites", *grid, cwd=tmp_path)
    assert (tmp_path / "grid" / "results.csv").is_file()
    install(clean, built["trilat-people"][1], stated)
    run_program(trilat, "experiment", "new", "reach.toml", cwd=tmp_path)
    assert "trials" in run_program(trilat, "experiment", "check", "reach.toml", cwd=tmp_path)
    page = "import trilat_people.live_page.page_files as p; print(*sorted(p._list_assets()))"
    assert "/three.module.min.js" in run_program(python, "-c", page, cwd=tmp_path).split()


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
    run_program(tools["check-wheel-contents"], built[CORE][1], cwd=ROOT)
    run_program(tools["twine"], "check", "--strict", *built[CORE], *built[WHOLE], cwd=ROOT)


def test_importing_the_package_imports_nothing_slow() -> None:
    """The bar is 30 ms: what it imports beyond an interpreter's start are a few modules of the library."""
    code = "import sys; before = set(sys.modules); import trilat_net; print(*(set(sys.modules) - before))"
    made = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    )
    extra = {name.partition(".")[0] for name in made.stdout.split()} - {"trilat_net"}
    assert extra <= sys.stdlib_module_names
    assert len(made.stdout.split()) < 60
