import re
import shlex
import shutil
import tomllib
from pathlib import Path

import pytest

import trilat_net as tn
from trilat_net.app.cli.options import RunOptions
from trilat_net.errors import ScenarioError
from trilat_net.scenario import list_shipped, load_scenario

from .running import trilat

EXAMPLES = Path(__file__).parents[2] / "examples"
SHIPPED = {"paper", "paper_rods", "free", "asymmetric", "two_sites"}


def test_list_names_scenarios_within_80_columns(tmp_path: Path) -> None:
    lines = trilat("scenario", "list", cwd=tmp_path).succeeds().splitlines()
    assert {line.split()[0] for line in lines[1:]} == set(list_shipped()) >= SHIPPED
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("name", list_shipped())
def test_show_fits_scenarios_to_80_columns(name: str) -> None:
    """The words are those of the file, printed unchanged."""
    scenario = load_scenario(name)
    assert f'about = """\n{scenario.about}"""' in scenario.text
    assert max(map(len, scenario.about.splitlines())) <= 80
    assert len(scenario.about.splitlines()) <= 16


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_shown_text_is_the_same_scenario(name: str, tmp_path: Path) -> None:
    text = trilat("scenario", "show", name, cwd=tmp_path).succeeds()
    copy = tmp_path / "copy.toml"
    copy.write_text(text)
    assert load_scenario(copy).sha256 == load_scenario(name).sha256
    output = trilat("scenario", "check", copy, cwd=tmp_path).succeeds()
    assert f"sha256 {load_scenario(name).sha256[:16]}" in output


def test_set_durations_win_over_the_default() -> None:
    """A page runs an hour, unless --set or --duration says otherwise."""
    assert RunOptions().load("two_sites", 3600.0).duration_s == 3600.0
    assert RunOptions().load("two_sites").duration_s == load_scenario("two_sites").duration_s
    assert RunOptions(duration=4.0).load("two_sites", 3600.0).duration_s == 4.0
    changed = RunOptions(overrides=["duration_s=5", "control.Kd=4"])
    assert changed.load("two_sites", 3600.0).duration_s == 5.0


def test_show_prints_overrides_resolved(tmp_path: Path) -> None:
    text = trilat(
        "scenario",
        "show",
        "paper",
        "--set",
        "control.Kd=5",
        "--set",
        "links.m1->s.delay_ms=7",
        "--duration",
        "3",
        "--seed",
        "9",
        cwd=tmp_path,
    ).succeeds()
    tables = tomllib.loads(text)
    assert all(site["control"]["Kd"] == [5.0, 5.0] for site in tables["sites"].values())
    assert tables["links"]["m1->s"]["delay_ms"] == 7.0
    assert tables["links"]["s->m1"]["delay_ms"] == 200.0
    assert (tables["duration_s"], tables["seed"]) == (3.0, 9)


def test_check_states_consequences_of_a_scenario(tmp_path: Path) -> None:
    text = trilat("scenario", "check", "asymmetric", cwd=tmp_path).succeeds()
    assert "weights of the sites in the proof of stability, pi with the sum 3 " in text
    assert ": m1 1.279, m2 0.4655, s 1.256" in text
    assert "20000 ticks of m1" in text
    assert "m2->s: 310 ms" in text
    assert "chosen here, not in the paper: " in text


def test_new_writes_a_template_and_keeps_files(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("precious")
    trilat("scenario", "new", path, cwd=tmp_path).refuses("mine.toml", "exists", "--force")
    assert path.read_text() == "precious"
    trilat("scenario", "new", path, "--force", cwd=tmp_path).succeeds()
    assert path.read_text().count("#") > 20
    trilat("scenario", "check", path, cwd=tmp_path).succeeds()


@pytest.mark.parametrize(
    "options", [(), ("--set", "sites.s.arm.dead_man=true"), ("--set", "control.Kd=7")]
)
def test_refused_real_arms_name_a_working_command(
    options: tuple[str, ...], tmp_path: Path
) -> None:
    shutil.copy(EXAMPLES / "two_operators.toml", tmp_path)
    wanted = ("--duration", "0.1", "--seed", "3", "-o", "rehearsal.mcap")
    sim = ("sim", "two_operators.toml", *wanted, *options)
    refused = trilat(*sim, cwd=tmp_path)
    assert refused.code == 2
    arguments = shlex.split(refused.err.rpartition("run: trilat ")[2])
    assert arguments[:2] == ["sim", "two_operators.toml"]
    trilat(*arguments, cwd=tmp_path).succeeds()
    settings = [word for word in arguments if "=" in word]
    assert set(options[1:]) <= set(settings), "what was asked for stays"
    log = tn.open_log(tmp_path / "rehearsal.mcap")
    assert (log.scenario.seed, log.scenario.duration_s) == (3, 0.1)


def test_other_commands_name_working_settings() -> None:
    with pytest.raises(ScenarioError, match="only run live") as refused:
        tn.simulate(EXAMPLES / "two_operators.toml", duration_s=0.1)
    settings = re.findall(r"set (\S+=\S+)", str(refused.value))
    log = tn.simulate(EXAMPLES / "two_operators.toml", settings, duration_s=0.1)
    assert log.scenario.outside == ()


def test_show_prints_the_scenario_of_a_log(tmp_path: Path) -> None:
    text = load_scenario("two_sites", {"duration_s": 0.2}).text
    (tmp_path / "own.toml").write_text(text, encoding="utf-8")
    trilat("sim", "./own.toml", "-o", "run.mcap", cwd=tmp_path).succeeds()
    ended = trilat("scenario", "show", "run.mcap", cwd=tmp_path)
    assert ended.succeeds() == text
    changed = trilat("scenario", "show", "run.mcap", "--seed", "3", cwd=tmp_path)
    changed.refuses("cannot be changed", "mine.toml")
