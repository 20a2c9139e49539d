"""Laws and arms from outside, by commands: working examples, and one sentence for each failure."""

import csv
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import trilat_net as tn
from tests.cli.running import trilat
from tests.execution.builders import make_external_arm_bytes
from trilat_net.log.log_reader import open_log

LAWS = Path(__file__).parents[1] / "laws.py"
DOC = Path(__file__).parents[2] / "docs" / "extend" / "own-controller.md"
INTERFACE = DOC.with_name("law-interface.md")
INPUTS = DOC.parents[1] / "data" / "law-inputs.csv"
FAILING = ("--set", "sites.s.control.law=tests.laws:Failing", "--set", "sites.s.control.at=40")
SHORT = ("--duration", "0.1")


def find_block(language: str) -> str:
    match = re.search(rf"```{language}\n(.*?)```", DOC.read_text(encoding="utf-8"), re.DOTALL)
    assert match is not None
    return match[1]


def test_the_page_works_as_written(tmp_path: Path) -> None:
    code = find_block("python")
    assert len([line for line in code.splitlines() if line]) <= 30
    (tmp_path / "mylaws.py").write_text(code)
    commands = [shlex.split(line, comments=True)[1:] for line in find_block("sh").splitlines()]
    sim, certify, report, verify, demo = commands
    for arguments in (certify, report):
        assert arguments[arguments.index("--law") + 1] == "mylaws.py"
    trilat(*sim, "--duration", "2", cwd=tmp_path).succeeds()
    log = open_log(tmp_path / "spring.mcap")
    assert {site.control.settings["K"] for site in log.scenario.sites.values()} == {80}
    assert max(np.abs(log[name].q[:1000]).max() for name in log.scenario.names) < 1e-12, (
        "they sink"
    )
    checked = trilat(*verify, cwd=tmp_path)
    assert checked.code == 0
    assert "6000/6000 records identical" in checked.out
    assert "mylaws:Spring of m1, m2, s with K = 80; its file is the one that ran" in checked.out
    assert demo[:2] == ["demo", "paper"]
    ended = trilat("sim", *demo[1:], *SHORT, "-o", "slave.mcap", cwd=tmp_path)
    ended.succeeds()
    assert open_log(tmp_path / "slave.mcap").scenario.sites["m1"].control.Kd == (3.0, 3.0)


@pytest.mark.long
def test_the_documented_law_holds_arms_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "holding_laws.py").write_text(find_block("python"))
    log = tn.simulate("paper", {"control.law": "holding_laws:Spring", "control.K": 80})
    assert tn.certify(log).stability == "open", "the law's code may not run"
    errors = np.abs(np.stack([log[name].e for name in log.scenario.names]))
    rest = np.stack([log[name].q[-1] for name in log.scenario.names])
    for said, measured in (
        ("more than %.3f rad,", errors.max()),
        ("at (%.3f, %.3f) rad", rest.mean(axis=0)),
    ):
        assert said % (measured if measured.ndim == 0 else tuple(measured)) in DOC.read_text()
    assert errors[:, -1].max() < 1e-6
    assert np.ptp(rest, axis=0).max() < 1e-6


@pytest.mark.long
def test_the_documented_certificate_is_printed(tmp_path: Path) -> None:
    (tmp_path / "mylaws.py").write_text(find_block("python"))
    sim, certify, *_ = (
        shlex.split(line, comments=True)[1:] for line in find_block("sh").splitlines()
    )
    trilat(*sim, cwd=tmp_path).succeeds()
    done = trilat(*certify, cwd=tmp_path)
    assert done.code == 0
    assert (
        trilat(*[w for w in certify if w not in ("--accept", "settled")], cwd=tmp_path).code
        == 1
    )
    assert done.out.startswith(find_block("text"))


def read_input_table() -> list[tuple[str, str, str]]:
    """Returns the fields of `now` in the page's table, with the shape and the unit of each."""
    rows = re.findall(r"^\| (`now\..*?) \| (.*?) \| (.*?) \|", DOC.read_text("utf-8"), re.M)
    fields = []
    for names, shape, units in rows:
        matches = re.findall(r"`now\.(\w+)`", names)
        stated = units.split(", ") if ", " in units else [units] * len(matches)
        stated = ["" if unit == "–" else unit for unit in stated]
        fields += [(name, shape, unit) for name, unit in zip(matches, stated, strict=True)]
    return fields


def test_documented_units_are_those_of_the_interface() -> None:
    with INPUTS.open(newline="", encoding="utf-8") as stream:
        units = {row["field"]: row["unit"] for row in csv.DictReader(stream)}
    table = read_input_table()
    assert len(table) == 11
    assert [(name, unit) for name, _, unit in table] == [
        (name_in_table, units[name_in_table]) for name_in_table, *_ in table
    ]


def test_documented_shapes_are_those_of_a_law(tmp_path: Path) -> None:
    sizes = {"n": "len({}) == now.joints", "a number": "{} + 0.0 == {}"}
    checks = [
        f"        assert {sizes[shape].format(f'now.{name}', f'now.{name}')}, {name!r}"
        for name, shape, _ in read_input_table()
        if shape in sizes
    ]
    per_peer = [f"        assert len(now.peers[1].{key}) == 2" for key in ("q", "qd", "tau_x")]
    lines = [
        "class Probe:",
        "    def __init__(self, facts):",
        "        assert len(facts.peers) == 2",
        "    def torque(self, now):",
        *checks,
        *per_peer,
        "        assert 0.0 < now.peers[0].alpha < 1.0 and now.peers[0].age_s >= 0.0",
        "        return [0.0] * now.joints",
    ]
    (tmp_path / "probing.py").write_text("\n".join(lines))
    trilat(
        "sim", "paper", *SHORT, "--set", "control.law=probing:Probe", cwd=tmp_path
    ).succeeds()


def test_a_law_gets_the_documented_values() -> None:
    from trilat_net.core.plug.user_law import LawContext, LawInput

    with INPUTS.open(newline="", encoding="utf-8") as stream:
        rows = [(row["object"], row["field"]) for row in csv.DictReader(stream)]
    assert f"data/{INPUTS.name})" in INTERFACE.read_text(encoding="utf-8")
    for kind in (LawContext, LawInput):
        assert [field for name, field in rows if name == kind.__name__] == list(kind._fields)


@pytest.fixture
def law(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    name = "".join(letter for letter in request.node.name if letter.isalnum())
    file = tmp_path / f"cli_{name}.py"
    file.write_text("from tests.laws import Adaptive\nclass Law(Adaptive):\n    pass\n")
    trilat(
        "sim", "two_sites", *SHORT, "--set", f"control.law={file.stem}:Law", cwd=tmp_path
    ).succeeds()
    return file


def test_outside_code_is_named_before_running(law: Path, tmp_path: Path) -> None:
    for command in (["verify"], ["verify", "--json"], ["rerun", "--closed-loop"]):
        done = trilat(command[0], "two_sites.mcap", *command[1:], "--law", law, cwd=tmp_path)
        assert done.code == 0
        assert done.err.startswith("note: executing this log runs code from outside: ")
        assert f"{law.stem}:Law of m, s; its file is the one that ran" in done.err


def test_changed_laws_are_judged_on_request(law: Path, tmp_path: Path) -> None:
    law.write_text(law.read_text() + "# a word\n")
    how = ("--law", law, "--other-version")
    trilat("verify", "two_sites.mcap", "--law", law, cwd=tmp_path).refuses(
        "is not the file that ran as"
    )
    assert trilat("verify", "two_sites.mcap", cwd=tmp_path).code == 4
    done = trilat("verify", "two_sites.mcap", *how, cwd=tmp_path)
    assert done.code == 0
    assert "its file was changed" in done.out
    assert "200/200 records identical" in done.out
    again = trilat("rerun", "two_sites.mcap", "--closed-loop", *how, cwd=tmp_path)
    assert "executed as its file is now" in again.out
    law.write_text(law.read_text().replace("pass", "def torque(self, now): return [0.0, 0.0]"))
    done = trilat("verify", "two_sites.mcap", *how, cwd=tmp_path)
    assert done.code == 1
    assert "its file was changed" in done.out
    assert "differ, the first: m, tick " in done.err


def test_missing_laws_are_not_judged(law: Path, tmp_path: Path) -> None:
    law.unlink()
    done = trilat("verify", "two_sites.mcap", cwd=tmp_path)
    assert done.code == 4
    assert "if you trust it: --law FILE" in done.err
    trilat("verify", "two_sites.mcap", "--law", law, cwd=tmp_path).refuses(
        law.stem, "cannot be read"
    )


def test_logs_are_read_without_their_code(law: Path, tmp_path: Path) -> None:
    law.unlink()
    assert (
        "200, none missing" in trilat("log", "info", "two_sites.mcap", cwd=tmp_path).succeeds()
    )
    done = trilat(
        "rerun",
        "two_sites.mcap",
        "--closed-loop",
        "--set",
        "control.law=adaptive",
        cwd=tmp_path,
    )
    assert done.code == 0


def test_failing_laws_give_one_sentence_and_a_log(tmp_path: Path) -> None:
    done = trilat("sim", "two_sites", *SHORT, *FAILING, cwd=tmp_path)
    done.refuses(
        "tests.laws:Failing of s failed at tick 40: torque[1] must be a finite number, but is nan",
        code=1,
    )
    assert open_log(tmp_path / "two_sites.mcap").complete
    checked = trilat("verify", "two_sites.mcap", "--virtual", "--law", LAWS, cwd=tmp_path)
    assert checked.code == 0
    assert "81/81 records identical" in checked.out


@pytest.mark.parametrize("seeds", ["1", pytest.param("1..3", marks=pytest.mark.long)])
def test_a_failing_law_fails_its_trial(seeds: str, tmp_path: Path) -> None:
    jitter = (
        "--set",
        "link.model=uniform",
        "--set",
        "link.delay_ms=9",
        "--set",
        "link.half_width_ms=1",
    )
    done = trilat("test", "two_sites", "--seeds", seeds, *jitter, *FAILING, cwd=tmp_path)
    assert done.code == 1
    assert "no result: " in done.out
    assert (
        "tests.laws:Failing of s failed at tick 40: torque[1] must be a finite number, but is nan"
        in done.out
    )


def test_failing_laws_in_reruns_are_one_sentence(tmp_path: Path) -> None:
    trilat("sim", "two_sites", *SHORT, cwd=tmp_path).succeeds()
    trilat("rerun", "two_sites.mcap", "--replace", "s", *FAILING, cwd=tmp_path).refuses(
        "tests.laws:Failing of s failed at tick 40", code=1
    )


@pytest.mark.parametrize("how", [["--closed-loop"], ["--replace", "s"]])
def test_external_arms_cannot_be_executed_again(how: list[str], tmp_path: Path) -> None:
    (tmp_path / "outside.mcap").write_bytes(make_external_arm_bytes())
    trilat("rerun", "outside.mcap", *how, cwd=tmp_path).refuses(
        "sites.s.plant", "as in --replace m"
    )
    assert trilat("rerun", "outside.mcap", "--replace", "m", cwd=tmp_path).code == 0
