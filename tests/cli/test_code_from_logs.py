"""Code from a log: no module is imported unless the user names its file
(docs/sessions/code-that-runs.md).
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
import pytest
import typer

import trilat_net as tn
from tests.cli.running import COMMAND, PLAIN, shorten, trilat
from tests.log.builders import edit_log_bytes, open_bytes
from trilat_net.app.cli import app
from trilat_net.errors import CodeWithheld, ScenarioError, UsageError
from trilat_net.own_code.imported_code import CodeKey, allowed_code, remembered_settings
from trilat_net.presentation.figures.registry import list_drawable_figures

WITNESS = "import os\nwith open(os.environ['WITNESS'], 'a') as told:\n    told.write(__file__ + ';')\n"
"""A module that begins so tells that it was imported."""
LAW = f"""{WITNESS}
class Spring:
    remembers = ()
    def __init__(self, facts, K=60.0):
        self.K = K
    def torque(self, now):
        return [now.gravity[i] - self.K * (now.q[i] - now.q_des[i]) for i in range(now.joints)]
"""
FILES = {
    "foreign": {
        "mylaws.py": f"{WITNESS}raise SystemExit('a stranger')\nclass Spring: torque = memory = recall = 1"
    },
    "changed": {"mylaws.py": f"{LAW}# a word\n"},
    "missing": {},
    "not a law": {"mylaws.py": f"{WITNESS}Spring = 1\n"},
    "beside the log": {"mylaws.py": LAW},
}
"""What stands in the working directory, beside a log that names mylaws:Spring for s."""

HANDS = ["figure", "run.mcap", "hands_moved", "--format", "png"]
SCRIPT = """
import trilat_net as tn
log = tn.open_log("run.mcap")
assert tn.verify("run.mcap", virtual=True, resume_every=10).result.withheld == ["s"]
tn.certify(log), tn.metrics(log), tn.rerun(log, ["m1"]), tn.figure(log, "overview")
def withheld(run):
    try:
        run()
    except tn.errors.CodeWithheld:
        return True
assert withheld(lambda: tn.rerun(log, ["s"]))
assert withheld(lambda: tn.certify(log, own_laws=True))
assert withheld(lambda: tn.simulate(log.scenario))
assert withheld(lambda: tn.simulate(log.scenario, {"control.K": 5}))
assert withheld(lambda: tn.linear(log.scenario))
"""
EXECUTING: list[tuple[list[str], int]] = [
    (["verify", "run.mcap", "--virtual"], 4),
    (["report", "run.mcap", "-o", "page"], 4),
    (["rerun", "run.mcap", "--closed-loop"], 4),
    (["twin", "run.mcap"], 4),
    (HANDS, 2),
]
READING: list[tuple[list[str], int]] = [
    (["certify", "run.mcap", "--own-laws"], 4),
    (["certify", "run.mcap", "--accept", "open"], 0),
    (["verify", "run.mcap", "--resume-every", "10", "--json"], 4),
    (["figure", "run.mcap", "--list"], 0),
    (["compare", "run.mcap", "run.mcap"], 0),
    (["metrics", "run.mcap"], 0),
    (["identify", "hand", "run.mcap"], 2),
    (["log", "info", "run.mcap"], 0),
    (["log", "check", "run.mcap"], 0),
    (["log", "recover", "run.mcap", "-o", "whole.mcap"], 0),
    (["log", "export", "run.mcap", "--to", "csv", "-o", "tables"], 0),
    (["-c", SCRIPT], 0),
]
CASES = [(arguments, code, law) for arguments, code in EXECUTING for law in FILES]
CASES += [(arguments, code, "beside the log") for arguments, code in READING]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    (folder / "mylaws.py").write_text(LAW)
    # A process of its own: this one imports a file once, and its workers set a module up twice.
    arguments = [
        "sim",
        "paper",
        "--duration",
        "0.05",
        "--set",
        "sites.s.control.law=mylaws:Spring",
    ]
    environment = {**PLAIN, "WITNESS": str(folder / "witness")}
    subprocess.run(
        [*COMMAND, *arguments, "-o", "run.mcap"], cwd=folder, env=environment, check=True
    )
    assert (folder / "witness").exists()  # it does tell
    before, now = (
        hashlib.sha256(source.encode()).hexdigest()
        for source in (LAW, FILES["not a law"]["mylaws.py"])
    )
    log = (folder / "run.mcap").read_bytes()
    text = open_bytes(log).scenario_text.replace(before, now)
    named = {"scenario_sha256": hashlib.sha256(text.encode()).hexdigest()}
    (folder / "not a law.mcap").write_bytes(
        edit_log_bytes(log, scenario=lambda _: text, session=named)
    )
    return folder


@pytest.fixture
def log_folder(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a log in which commands run; no code is allowed or remembered."""
    shutil.copy(logs / "run.mcap", tmp_path)
    monkeypatch.setenv("WITNESS", str(tmp_path / "witness"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    monkeypatch.chdir(tmp_path)
    before = dict(allowed_code)
    allowed_code.clear()
    remembered_settings.clear()
    yield tmp_path
    allowed_code.update(before)  # logs that other tests keep name laws


def _find_marks(arguments: list[str], law: str) -> tuple[Any, ...]:
    brief = arguments[0] in ("verify", "rerun") or "--own-laws" in arguments
    return (
        ()
        if brief and "--json" not in arguments and law == "beside the log"
        else (pytest.mark.long,)
    )


@pytest.mark.parametrize(
    ("arguments", "code", "law"),
    [
        pytest.param(
            *case,
            id=f"{' '.join(case[0][:3])[:30]!r} {case[2]}",
            marks=_find_marks(case[0], case[2]),
        )
        for case in CASES
    ],
)
def test_no_command_imports_modules_named_in_logs(
    arguments: list[str], code: int, law: str, logs: Path, log_folder: Path
) -> None:
    for name, text in FILES[law].items():
        (log_folder / name).write_text(text)
    if law == "not a law":
        shutil.copy(logs / "not a law.mcap", log_folder / "run.mcap")
    command = [COMMAND[0], *arguments] if arguments[0] == "-c" else [*COMMAND, *arguments]
    environment = {
        **PLAIN,
        "WITNESS": os.environ["WITNESS"],
        "XDG_CONFIG_HOME": os.environ["XDG_CONFIG_HOME"],
    }
    done = subprocess.run(
        command, cwd=log_folder, env=environment, capture_output=True, text=True
    )
    assert not (log_folder / "witness").exists()
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "code",
    [
        "distutils.core:Law",
        *(
            pytest.param(code, marks=pytest.mark.long)
            for code in ("distutils:Law", "a.b.c:Law")
        ),
    ],
)
def test_looking_for_a_module_runs_no_code(code: str, log_folder: Path) -> None:
    """Python's finder of distutils imports the setuptools that is nearest."""
    for name in ("setuptools/__init__.py", "distutils/__init__.py", "a/b/c.py"):
        (log_folder / name).parent.mkdir(parents=True)
        (log_folder / name).write_text(WITNESS)
    log = (log_folder / "run.mcap").read_bytes()
    text = open_bytes(log).scenario_text.replace("mylaws:Spring", code)
    named = {"scenario_sha256": hashlib.sha256(text.encode()).hexdigest()}
    (log_folder / "run.mcap").write_bytes(
        edit_log_bytes(log, scenario=lambda _: text, session=named)
    )
    done = subprocess.run(
        [*COMMAND, "verify", "run.mcap"], cwd=log_folder, capture_output=True, text=True
    )
    assert (done.returncode, list_imports(log_folder)) == (4, []), done.stderr
    assert "Traceback" not in done.stderr


def test_verify_names_skipped_code_and_its_permission(
    tmp_path: Path,
) -> None:
    # The other tests need to be the first that import mylaws.
    (tmp_path / "permitted.py").write_text(LAW.removeprefix(WITNESS))
    setting = ("--set", "control.law=permitted:Spring")
    trilat(
        "sim", "paper", "--duration", "0.05", *setting, "-o", "own.mcap", cwd=tmp_path
    ).succeeds()
    withheld = trilat("verify", "own.mcap", cwd=tmp_path)
    assert withheld.code == 4
    assert "records: 150 in the file; m1, m2, s not judged" in withheld.out
    assert "m1, m2 and s were not executed" in withheld.err
    assert "--law FILE" in withheld.err
    allowed = trilat("verify", "own.mcap", "--law", "permitted.py", cwd=tmp_path)
    assert allowed.code == 0, allowed
    assert "150/150 records identical" in allowed.out


def test_the_table_covers_every_requested_case() -> None:
    assert len(CASES) >= 26
    assert {law for _, _, law in CASES} == set(FILES)


def list_commands(command: Any, *arguments: str) -> Iterator[str]:
    """Returns every command of the program, by its words."""
    if not hasattr(command, "commands"):
        yield " ".join(arguments)
        return
    for name, inner in command.commands.items():
        yield from list_commands(inner, *arguments, name)


RUN_NONE = {
    "metrics",
    "identify hand",
    "replay",
    "watch",
    "stop",
    "enable",
    "reset",
    "log info",
    "log check",
    "log sign",
    "log recover",
    "log export",
    "set link",
    "set dominance",
    "router",
    "ros2",
    "doctor",
    "scenario list",
    "scenario show",
    "scenario check",
    "scenario new",
    "trace import",
    "experiment new",
    "experiment check",
    "experiment power",
    "experiment status",
    "experiment analyse",
    "keys new",
    "keys add",
    "keys renew",
    "keys pair",
    "keys info",
    "new law",
    "new hand",
    "new plant",
}
"""Commands of which the page says that they run no code that a log or a scenario names."""


@pytest.mark.push
def test_the_page_lists_every_command() -> None:
    """A row of `docs/sessions/code-that-runs.md` says of each command whose code it runs;
    commands without row run none.
    """
    page = Path(__file__).parents[2] / "docs" / "sessions" / "code-that-runs.md"
    rows = [
        line
        for line in page.read_text(encoding="utf-8").splitlines()
        if line.startswith("| `trilat ")
    ]
    named = {
        " ".join(
            word
            for word in command.removeprefix("trilat ").split()
            if word.islower() and word[0] != "-"
        )
        for row in rows
        for command in re.findall("`([^`]+)`", row.split(" | ")[0])
    }
    assert not named & RUN_NONE
    assert named | RUN_NONE == set(list_commands(typer.main.get_command(app)))


RUNNING_OWN: dict[str, list[str]] = {
    "sim": ["sim", "own.toml", "-o", "sim.mcap"],
    "test": ["test", "own.toml", "--jobs", "1"],
    "linear": ["linear", "own.toml"],
    "sweep": ["sweep", "own.toml", "--over", "links.m1->s.delay_ms=0,20", "--jobs", "1"],
    "experiment run": ["experiment", "run", "own-reaching.toml", "--jobs", "1"],
}
ONLY_NAMING_OWN: dict[str, list[str]] = {
    "scenario show": ["scenario", "show", "own.toml"],
    "scenario check": ["scenario", "check", "own.toml"],
    "experiment check": ["experiment", "check", "own-reaching.toml"],
}


@pytest.mark.long
@pytest.mark.parametrize("name", [*RUNNING_OWN, *ONLY_NAMING_OWN])
def test_commands_run_own_code_as_documented(name: str, log_folder: Path) -> None:
    (log_folder / "mylaws.py").write_text(LAW)
    setting = ("--set", "sites.s.control.law=mylaws:Spring", "--set", "duration_s=0.5")
    output = trilat("scenario", "show", "paper", *setting, cwd=log_folder).succeeds()
    (log_folder / "own.toml").write_text(
        output.replace("synchronised_by_s = 12.0", "synchronised_by_s = 0.4")
    )
    trilat("experiment", "new", "own-reaching.toml", cwd=log_folder).succeeds()
    shorten(log_folder / "own-reaching.toml")
    protocol = (log_folder / "own-reaching.toml").read_text(encoding="utf-8")
    (log_folder / "own-reaching.toml").write_text(
        protocol.replace('"paper"', '"./own.toml"', 1)
    )
    arguments = {**RUNNING_OWN, **ONLY_NAMING_OWN}[name]
    done = subprocess.run(
        [*COMMAND, *arguments], cwd=log_folder, capture_output=True, text=True
    )
    assert "Traceback" not in done.stderr, done.stderr
    assert bool(list_imports(log_folder)) == (name in RUNNING_OWN), done


def list_imports(place: Path) -> list[str]:
    witness = place / "witness"
    return witness.read_text().split(";")[:-1] if witness.exists() else []


def test_only_the_named_file_runs(log_folder: Path) -> None:
    (log_folder / "mylaws.py").write_text(FILES["foreign"]["mylaws.py"])
    (log_folder / "kept").mkdir()
    file = log_folder / "kept" / "spring-v1.py"
    file.write_text(LAW)
    log = tn.open_log("run.mcap", law=file)
    assert tn.verify(log, virtual=True).passed
    assert list_imports(log_folder) == [str(file)]
    tn.verify("run.mcap")  # this process has it already
    assert list_imports(log_folder) == [str(file)]
    assert not list(file.parent.glob("__pycache__"))


def test_caches_beside_a_law_never_run(log_folder: Path) -> None:
    import importlib.util
    import py_compile

    file = log_folder / "mylaws.py"
    other = log_folder / "other.py"
    file.write_text(LAW)
    other.write_text("raise SystemExit('cached')")
    cached = importlib.util.cache_from_source(str(file))
    py_compile.compile(
        str(other), cached, invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH
    )
    assert tn.verify(tn.open_log("run.mcap", law=file)).passed


@pytest.mark.parametrize(
    ("text", "name", "error", "fact"),
    [
        (
            f"{LAW}# a word\n",
            "mylaws.py",
            UsageError,
            "is not the file that ran as mylaws:Spring",
        ),
        (
            f"{LAW}# a word\n",
            "other.py",
            UsageError,
            "does not contain code that the log names; the log names mylaws:Spring",
        ),
        (f"{WITNESS}Spring = 1", "mylaws.py", ScenarioError, "defines no class Spring"),
        (
            f"{WITNESS}class Spring: pass",
            "mylaws.py",
            ScenarioError,
            "is not a law: the class has no torque",
        ),
        (f"{WITNESS}class Spring(", "mylaws.py", ScenarioError, "is not valid Python"),
        (None, "mylaws.py", ScenarioError, "cannot be read"),
    ],
)
def test_a_different_file_is_refused_before_running(
    text: str | None, name: str, error: type[Exception], fact: str, log_folder: Path
) -> None:
    if text is not None:
        (log_folder / name).write_text(text)
    is_asked = fact.startswith(("defines", "is not a law: the", "is not valid Python"))
    with pytest.raises(error, match=fact):
        tn.open_log("run.mcap", law=name, other_version=is_asked)
    done = trilat(
        "verify", "run.mcap", "--law", name, *["--other-version"] * is_asked, cwd=log_folder
    )
    done.refuses(fact)
    assert not list_imports(log_folder)


def test_files_changed_after_permission_do_not_run(log_folder: Path) -> None:
    file = log_folder / "mylaws.py"
    file.write_text(LAW)
    log = tn.open_log("run.mcap", law=file)
    file.write_text(f"{LAW}# a word\n")
    assert tn.verify(log).result.withheld == ["s"]
    with pytest.raises(ScenarioError, match="its hash is not the permitted one"):
        tn.rerun(log, ["s"])
    assert not list_imports(log_folder)


def test_a_remembered_file_runs_for_its_hash(log_folder: Path) -> None:
    file = log_folder / "kept.py"
    file.write_text(LAW)
    trilat("verify", "run.mcap", "--remember", cwd=log_folder).refuses("give --law FILE, too")
    assert trilat("verify", "run.mcap", "--law", file, "--remember", cwd=log_folder).code == 0
    assert trilat("verify", "run.mcap", cwd=log_folder).code == 0
    file.write_text(f"{LAW}# a word\n")
    assert trilat("verify", "run.mcap", cwd=log_folder).code == 4


READER = """import os
class Spring:
    remembers = ()
    def __init__(self, facts, K=60.0, table="gains.csv"):
        self.K = K
        with open(table) as opened, open(os.environ["WITNESS"], "a") as told:
            told.write(opened.name + ";")
    def torque(self, now):
        return [now.gravity[i] - self.K * (now.q[i] - now.q_des[i]) for i in range(now.joints)]

class Other(Spring):
    pass
"""
"""A harmless law that reads the file which its scenario names."""


def save_log_of_reader(
    place: Path, name: str, settings: dict[str, Any], kind: str = "Spring"
) -> None:
    """Saves a log whose author ran the same file with settings of their choice."""
    written = {f"control.{key}": value for key, value in settings.items()}
    log = tn.simulate(
        "two_sites", {"control.law": f"mylaws:{kind}", **written}, duration_s=0.05
    )
    log.save(name)
    allowed_code.clear()
    (place / "witness").unlink()


@pytest.fixture
def reader(log_folder: Path) -> Path:
    """Writes a law that reads a file, a log of its user, and logs of strangers with the same hash."""
    (log_folder / "mylaws.py").write_text(READER)
    for name in ("gains.csv", "secret.txt"):
        (log_folder / name).write_text("1")
    save_log_of_reader(log_folder, "own.mcap", {"K": 50.0})
    save_log_of_reader(
        log_folder, "stranger.mcap", {"K": 50.0, "table": str(log_folder / "secret.txt")}
    )
    save_log_of_reader(log_folder, "class.mcap", {"K": 50.0}, "Other")
    return log_folder


def test_remembered_file_runs_with_remembered_settings_alone(reader: Path) -> None:
    remembered = trilat("verify", "own.mcap", "--law", "mylaws.py", "--remember", cwd=reader)
    assert remembered.code == 0, remembered.err
    assert trilat("verify", "own.mcap", cwd=reader).code == 0
    (reader / "witness").unlink()
    refused = trilat("verify", "stranger.mcap", cwd=reader)
    assert refused.code == 4
    assert not list_imports(reader)
    for fact in ("it was allowed with other settings", 'secret.txt" (was its default)'):
        assert fact in refused.err
    assert trilat("verify", "class.mcap", cwd=reader).code == 4
    assert not list_imports(reader)
    named = trilat("verify", "stranger.mcap", "--law", "mylaws.py", "--remember", cwd=reader)
    assert named.code == 0
    assert 'secret.txt"' in named.err  # what it ran with is said
    assert [
        trilat("verify", name, cwd=reader).code for name in ("own.mcap", "stranger.mcap")
    ] == [0, 0]


def test_law_of_own_run_allows_no_strangers_settings(reader: Path) -> None:
    """A notebook that has run a law opens a stranger's log of the same law."""
    tn.simulate(
        "two_sites", {"control.law": "mylaws:Spring", "control.K": 50.0}, duration_s=0.05
    )
    assert tn.verify("own.mcap").passed
    (reader / "witness").unlink(missing_ok=True)
    log = tn.open_log("stranger.mcap")
    assert tn.verify(log).result.withheld == ["m", "s"]
    for run in (
        lambda: tn.rerun(log, ["s"]),
        lambda: tn.rerun(log, ["s"], {"sites.s.control.K": 60.0}),
        lambda: tn.certify(log, own_laws=True),
        lambda: tn.simulate(log.scenario),
    ):
        with pytest.raises(CodeWithheld, match=r"secret\.txt"):
            run()
    assert not list_imports(reader)


def test_figures_run_only_permitted_laws(reader: Path) -> None:
    stranger = tn.open_log("stranger.mcap")
    tn.figure(stranger, "overview")
    assert "twins" not in list_drawable_figures(stranger)
    assert not list_imports(reader)
    log = tn.open_log("own.mcap", law="mylaws.py")
    assert not list_imports(reader)
    tn.figure(log, "overview")
    assert list_imports(reader)
    assert "twins" in list_drawable_figures(log)
    (reader / "witness").unlink()
    tn.figure(stranger, "overview")  # the permission is for other settings
    assert not list_imports(reader)


@pytest.mark.usefixtures("reader")
def test_settings_changed_by_a_person_may_run() -> None:
    log = tn.open_log("own.mcap", law="mylaws.py")
    again = tn.rerun(log, ["s"], {"sites.s.control.K": 60.0})
    assert again.sites["s"].executed == 50
    tn.simulate(log.scenario, {"control.K": 55.0}, duration_s=0.01)


def test_remembered_file_without_settings_allows_nothing(reader: Path) -> None:
    store = Path(os.environ["XDG_CONFIG_HOME"], "trilat-net", "laws.json")
    store.parent.mkdir(parents=True)
    sha256 = hashlib.sha256(READER.encode()).hexdigest()
    store.write_text(json.dumps({sha256: str(reader / "mylaws.py")}))
    assert trilat("verify", "own.mcap", cwd=reader).code == 4
    assert not list_imports(reader)
    assert (
        trilat("verify", "own.mcap", "--law", "mylaws.py", "--remember", cwd=reader).code == 0
    )
    assert trilat("verify", "own.mcap", cwd=reader).code == 0


@pytest.mark.parametrize(
    "keys",
    [
        {"sites.s.plant": {"class": "tests.own_code:Carousel", "how": "few"}},
        {
            "sites.m2.hands": [
                {"kind": "own", "class": "tests.own_code:Circle", "settings": {"turn_s": 1.0}}
            ]
        },
        {"sites.s.control.law": "tests.own_laws:PD"},
    ],
    ids=["plant", "hand", "law"],
)
@pytest.mark.usefixtures("log_folder")
def test_code_with_other_settings_is_withheld(keys: dict[str, Any]) -> None:
    allowed = tn.load_scenario("paper", keys)
    parts = [(site.control, *site.hands, site.plant) for site in allowed.sites.values()]
    (named,) = [part for part in chain(*parts) if hasattr(part, "source_sha256")]
    others = {**named.settings, "table": "/etc/passwd"}
    other = msgspec.structs.replace(named, settings=others)
    with pytest.raises(CodeWithheld, match=r'table = "/etc/passwd" \(was its default\)'):
        CodeKey.of(other).import_class("sites.s", named.method)


def test_laws_of_this_process_need_no_permission(log_folder: Path) -> None:
    (log_folder / "ownlaw.py").write_text(LAW)
    log = tn.simulate("two_sites", {"control.law": "ownlaw:Spring"}, duration_s=0.05)
    log.save("own.mcap")
    assert tn.verify("own.mcap").passed
    assert (
        tn.rerun("run.mcap", ["s"], {"sites.s.control.law": "ownlaw:Spring"})
        .sites["s"]
        .executed
        == 50
    )
    with pytest.raises(CodeWithheld):
        tn.rerun("run.mcap", ["s"])


@pytest.mark.long
def test_a_compiled_law_runs_from_the_named_file(log_folder: Path) -> None:
    folder = log_folder / "laws"
    folder.mkdir()
    (log_folder / "gains.py").write_text(WITNESS)  # of the working directory
    (folder / "gains.py").write_text("K = 60.0\n")
    (folder / "quick.py").write_text(
        "import dataclasses\nimport trilat_net\nfrom gains import K\n"
        "@dataclasses.dataclass\nclass Note:\n    text: 'str' = ''\n"
        "@trilat_net.compiled\nclass Spring:\n    remembers = ()\n"
        "    def __init__(self, facts):\n        self.K = K\n"
        "    def torque(self, now):\n        for i in range(now.joints):\n"
        "            now.tau[i] = now.gravity[i] - self.K * (now.q[i] - now.q_des[i])\n"
    )
    ended = trilat(
        "sim",
        "two_sites",
        "--duration",
        "0.05",
        "--set",
        "control.law=quick:Spring",
        cwd=folder,
    )
    assert ended.code == 0
    allowed_code.clear()
    process = subprocess.run(
        [*COMMAND, "verify", "laws/two_sites.mcap", "--law", "laws/quick.py"],
        cwd=log_folder,
        capture_output=True,
        text=True,
    )
    assert "100/100 records identical" in process.stdout, process.stderr
    assert not list_imports(log_folder)
