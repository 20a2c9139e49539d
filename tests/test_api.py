"""The interface of `import trilat_net`: every function of the command, documented by examples that run."""

import doctest
import inspect
import json
import pickle
import subprocess
import sys
from collections.abc import Callable, Mapping
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import trilat_net as tn
from tests.cli.running import trilat
from tests.golden.surface import all_options
from tests.json_outline import TABLE, is_documented
from tests.json_samples import build_table
from tests.laws import Adaptive
from trilat_net.errors import ScenarioError, TrilatError, UsageError
from trilat_net.results import Result

FUNCTIONS = [name for name in tn.__all__ if name != "__version__"]


def test_completions_are_the_existing_names() -> None:
    assert dir(tn) == sorted(tn.__all__)
    assert all(getattr(tn, name) for name in dir(tn))


@pytest.mark.parametrize(
    "package",
    [
        "gymnasium",
        *(
            pytest.param(name, marks=pytest.mark.long)
            for name in ("matplotlib", "scipy", "loky", "polars", "websockets")
        ),
    ],
)
def test_a_missing_package_shows_in_the_call(package: str) -> None:
    """The call runs in a separate interpreter, since earlier imports would stay."""
    script = f"""
import sys
sys.modules[{package!r}] = None
import trilat_net as tn
from trilat_net.errors import UsageError
for name in dir(tn):
    assert hasattr(tn, name), name
missing = [name for name in dir(tn) if (getattr(tn, name).__doc__ or "").startswith("Is not available")]
for name in missing:
    try:
        getattr(tn, name)("paper")
    except UsageError as error:
        assert {package!r} in str(error), error
    else:
        raise SystemExit(name)
print(*missing)
"""
    missing = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True
    ).stdout.split()
    assert ("make_env" in missing) == (package == "gymnasium")
    assert ("figure" in missing) == (package in ("matplotlib", "scipy"))


COUNTERPARTS = {
    "import_trace": ["trace import"],
    "run": ["demo"],
    "start": ["live", "site", "hand", "record", "watch", "router", "ros2", "replay"],
    "session": ["ping", "stop", "enable", "reset", "set link", "set dominance"],
    "simulate": ["sim"],
    "tune_arm": ["tune"],
    "compare": ["compare"],
    "info": ["log info"],
    "check_file": ["log check"],
    "sign_log": ["log sign"],
    "recover": ["log recover"],
    "export": ["log export"],
    "view": ["log view"],
    "check": ["test"],
    "ping_benchmark": ["ping"],
    "list_shipped": ["scenario list"],
    "load_scenario": ["scenario show"],
    "describe_scenario": ["scenario check"],
    "read_template": ["scenario new"],
    **{f"new_{kind}": [f"new {kind}"] for kind in ("law", "hand", "plant")},
    "new_experiment": ["experiment new"],
    "check_experiment": ["experiment check"],
    "run_experiment": ["experiment run"],
    "open_experiment": ["experiment status"],
    "analyse_experiment": ["experiment analyse"],
    "compute_experiment_power": ["experiment power"],
    "identify_hand": ["identify hand"],
    "create_keys": ["keys new"],
    "renew_keys": ["keys renew"],
    "add_keys": ["keys add"],
    "create_signing_keys": ["keys pair"],
    "read_member_keys": ["keys info"],
    **{
        name: [name]
        for name in (
            "doctor",
            "verify",
            "certify",
            "metrics",
            "figure",
            "report",
            "rerun",
            "twin",
        )
    },
    **{name: [name] for name in ("sweep", "bench", "linear")},
}
"""By name in Python the commands that do the same."""


def test_every_command_has_a_counterpart() -> None:
    names = [name.removeprefix("trilat ") for name in all_options() if name != "trilat"]
    commands = {
        name for name in names if not any(other.startswith(f"{name} ") for other in names)
    }
    assert {command for done in COUNTERPARTS.values() for command in done} == commands
    assert not COUNTERPARTS.keys() - set(dir(tn))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_name_has_a_docstring_with_an_example(name: str) -> None:
    text = inspect.getdoc(getattr(tn, name)) or ""
    assert doctest.DocTestParser().get_examples(text), f"{name} shows no example"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_example_of_a_docstring_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = inspect.getdoc(getattr(tn, name)) or ""
    example = doctest.DocTestParser().get_doctest(text, {"tn": tn}, name, None, None)
    printed: list[str] = []
    result = doctest.DocTestRunner(verbose=False).run(example, out=printed.append)
    assert result.failed == 0, "".join(printed)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tn.simulate("two_sites", duration_s=0.2).save(
        tmp_path_factory.mktemp("api") / "run.mcap"
    )


class _Texts(HTMLParser):
    """The texts of a page, without its marks."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self._text = ""
        self.feed(page)
        self.words = self._text.split()

    def handle_starttag(self, tag: str, _attrs: list[tuple[str, str | None]]) -> None:
        self._text += "" if tag == "span" else " "  # a span may stand within a word

    def handle_data(self, data: str) -> None:
        self._text += data


RESULTS: dict[str, Callable[[Path], Result]] = {
    "certify": tn.certify,
    "twin": tn.twin,
    "metrics": tn.metrics,
    "verify": tn.verify,
    "log info": tn.info,
    "log check": tn.check_file,
    "compare": lambda file: tn.compare(file, file),
    "rerun": lambda file: tn.rerun(file, ["s"], {"control.Kd": 5}),
}


@pytest.mark.parametrize("command", RESULTS)
def test_results_print_as_their_command_does(
    command: str, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a short name: the command lays out tables for the width of its terminal."""
    monkeypatch.chdir(file.parent)
    file = Path(file.name)
    more = {
        "compare": [file, "--all"],
        "rerun": ["--replace", "s", "--set", "control.Kd=5"],
        "certify": ["--all"],
        "metrics": ["--all"],
    }.get(command, [])
    result = RESULTS[command](file)
    printed = trilat(*command.split(), file, *more, cwd=Path.cwd())
    assert result.summary().split() == (printed.out + printed.err).split()
    as_json = json.loads(trilat(*command.split(), file, *more, "--json", cwd=Path.cwd()).out)
    assert {**as_json, "file": None} == {
        **json.loads(json.dumps(result.to_dict())),
        "file": None,
    }
    assert "\n" not in repr(result)
    assert repr(result).startswith(f"<{type(result).__name__} ")
    assert _Texts(result._repr_html_()).words == result.summary().split()
    assert is_documented(command, result.to_dict())
    frame = result.to_frame()
    assert len(frame) == len(result.to_rows()) > 0


def test_saved_simulations_equal_the_commands_files(tmp_path: Path) -> None:
    log = tn.simulate("jitter", duration_s=0.3, seed=4)
    log.save(tmp_path / "api.mcap")
    trilat("sim", "jitter", "--duration", "0.3", "--seed", "4", "-o", "cli.mcap", cwd=tmp_path)
    assert (tmp_path / "api.mcap").read_bytes() == (tmp_path / "cli.mcap").read_bytes()
    with pytest.raises(UsageError, match="exists"):
        log.save(tmp_path / "api.mcap")


def test_logs_are_not_changed_by_accident(file: Path) -> None:
    site = tn.open_log(file)["m"]
    for values in (site.q, site.t_s, site.tick, site.used["s"], site.theta_hat):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1


def test_logs_complete_sites_and_become_frames(file: Path) -> None:
    log = tn.open_log(file)
    assert log._ipython_key_completions_() == ["m", "s"]
    assert list(log.to_frame()["records"]) == [200, 200]
    frame = log.to_frame("m")
    assert np.array_equal(frame["q1_rad"], log["m"].q[:, 0])
    assert log.frame("m").to_pandas().equals(frame)
    assert len(log.to_frame("events")) == len(log.events)


def test_scenarios_are_names_texts_tables_or_themselves(tmp_path: Path) -> None:
    named = tn.load_scenario("two_sites", ["duration_s=0.5"])
    text = named.text
    (tmp_path / "mine.toml").write_text(text)
    for source in (named, text, tmp_path / "mine.toml"):
        assert tn.load_scenario(source) == named
    assert tn.load_scenario("two_sites", {"control.Kd": 5}, seed=3).seed == 3


def test_a_log_is_a_mapping_of_its_sites(file: Path) -> None:
    log = tn.open_log(file)
    assert isinstance(log, Mapping)
    assert (list(log), len(log), "m" in log, "x" in log) == (["m", "s"], 2, True, False)
    assert {name: part.q.shape for name, part in log.items()} == dict.fromkeys("ms", (200, 2))
    assert log.get("x") is None
    assert {log: 1}[log] == 1
    assert log != tn.open_log(file)


def test_diverged_runs_are_marked() -> None:
    keys = {"limits.qd_limit_rad_s": 0.5}
    with pytest.warns(
        RuntimeWarning, match=r"the run diverged at .* s, and ends there"
    ) as caught:
        log = tn.simulate("two_sites", keys, duration_s=5)
    assert caught[0].filename == __file__
    assert log.diverged_s == min(
        part.t_s[-1] for part in log.values() if part.mode[-1] == "diverged"
    )
    assert f"DIVERGED at {log.diverged_s:.3f} s" in repr(log)
    still = tn.simulate("two_sites", duration_s=0.1)
    assert still.diverged_s is None
    assert "DIVERGED" not in repr(still)


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "scenario": (lambda _: tn.simulate(42), "42: there is no scenario of that name"),
    "set": (
        lambda _: tn.simulate("two_sites", 5),
        "an override must have the form KEY=VALUE, as in control.Kd=5, not 5",
    ),
    "set[]": (
        lambda _: tn.simulate("two_sites", [5]),
        "an override must have the form KEY=VALUE",
    ),
    "set key": (lambda _: tn.simulate("two_sites", {5: 5}), "5: unknown key"),
    "set value": (
        lambda _: tn.simulate("two_sites", {"control.Kd": None}),
        "control.Kd: expected",
    ),
    "log": (lambda _: tn.open_log("nothing.mcap"), "^nothing.mcap cannot be read"),
    "log is none": (
        lambda _: tn.verify(None),
        "a log must be given as a path or as a file opened for reading, not None",
    ),
    "site": (
        lambda file: tn.open_log(file)["x"],
        "^there is no site 'x' in .*; the sites are m, s$",
    ),
    "table": (lambda file: tn.open_log(file).table("m", "x"), "^m has no table 'x'"),
    "save": (
        lambda file: tn.simulate("two_sites", duration_s=0.1).save(file),
        "replace it with force=True$",
    ),
    "report": (
        lambda file: tn.report(file, file.parent),
        "choose another folder, or use force=True$",
    ),
    "run": (
        lambda file: tn.run("two_sites", out=file.parent),
        "choose another folder, or use force=True$",
    ),
    "sweep out": (
        lambda file: tn.sweep("free", "control.Kd=1,2", out=file.parent),
        "another folder$",
    ),
    "export": (lambda file: tn.export(file, "npz", file), "replace it with force=True$"),
    "sweep seeds": (
        lambda _: tn.sweep("free", "control.Kd=1,2", seeds="1..3"),
        "^seeds must be a number from 1",
    ),
    "sweep over": (lambda _: tn.sweep("free", 5), "^over must have the form KEY=VALUES"),
    "sweep law": (lambda _: tn.sweep("free", laws="pd"), "^laws: there is no law 'pd'"),
    "margin": (lambda _: tn.margin("free", "x"), "^along must have the form KEY=FROM:TO"),
    "tune": (lambda _: tn.tune("free", gravity_percent=5), "^gravity_percent must be from 50"),
    "rerun": (
        lambda file: tn.rerun(file),
        r"replace=NAME \(one of m, s\), or closed_loop=True for all",
    ),
    "figure": (lambda file: tn.figure(file, "positions", "x"), "3.5 or 7 inches, not x"),
    "linear": (
        lambda _: tn.linear("two_sites", pose=["x"]),
        "a pose must consist of angles in rad",
    ),
    "bench": (lambda _: tn.bench(seeds=0), "^seeds must be a number from 1 to 1000, not 0"),
}


@pytest.mark.parametrize("what", WRONG)
def test_python_errors_have_one_type_with_arguments(what: str, file: Path) -> None:
    call, phrase = WRONG[what]
    with pytest.raises(TrilatError, match=phrase) as caught:
        call(file)
    assert "--" not in str(caught.value)


def test_errors_name_arguments_and_whole_commands() -> None:
    error = UsageError(
        "x: trilat log recover x --force; or take -o, --seeds 5, --keys DIR or --force"
    )
    assert (
        str(error)
        == "x: trilat log recover x --force; or take out, seeds=5, keys=DIR or force=True"
    )
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_numbers_of_numpy_are_numbers() -> None:
    keys = {
        "control.Kd": np.array([5.0, 5.0]),
        "control.Kp": np.float64(2.0),
        "seed": np.int64(3),
    }
    same = {"control.Kd": 5.0, "control.Kp": 2.0, "seed": 3, "duration_s": 0.5}
    scenario = tn.load_scenario("two_sites", keys, duration_s=np.float32(0.5))
    assert scenario == tn.load_scenario("two_sites", same)


def test_a_law_is_given_as_its_class() -> None:
    log = tn.simulate("two_sites", {"control.law": Adaptive, "control.Kp": 2.0}, duration_s=0.1)
    assert {site.control.code for site in log.scenario.sites.values()} == {
        "tests.laws:Adaptive"
    }
    (trial,) = tn.trials("free", set={"control.law": Adaptive})
    assert trial.overrides == ('control.law="tests.laws:Adaptive"',)

    class Local(Adaptive):
        """A law defined in no file."""

    with pytest.raises(ScenarioError, match="is not defined in a file"):
        tn.simulate("two_sites", {"control.law": Local})


def test_pages_named_in_errors_exist() -> None:
    with pytest.raises(ScenarioError) as refused:
        tn.simulate("two_sites", {"control.law": "tests.laws:nobody"}, duration_s=0.1)
    assert Path(str(refused.value).rpartition("see ")[2]).is_file()


@pytest.mark.long
def test_the_table_of_keys_matches_the_results() -> None:
    assert TABLE.read_text(encoding="utf-8") == build_table()


def test_a_run_stands_for_its_scenario() -> None:
    run = tn.simulate("two_sites", {"control.Kd": 5.0}, duration_s=0.02)
    assert tn.load_scenario(run).text == run.scenario.text
    assert tn.linear(run, ports=False).verdict == tn.linear(run.scenario, ports=False).verdict
