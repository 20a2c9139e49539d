"""`trilat new law`, `hand`, `plant`: skeletons that work, and their tests, which pass."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import trilat_net as tn
from tests.cli.running import start_command, trilat


def test_the_skeleton_is_a_law_and_replaces_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = trilat("new", "law", "soft_law.py", cwd=tmp_path)
    assert ended.code == 0
    assert "--set control.law=soft_law:SoftLaw" in ended.out
    assert "python -m pytest test_soft_law.py" in ended.out
    assert "trilat report soft_law.mcap --law soft_law.py" in ended.out
    head = (tmp_path / "soft_law.py").read_text().split('"""')[1]
    printed = [line.strip() for line in ended.out.splitlines() if line.startswith("  trilat")]
    assert len(printed) == 3
    assert [line for line in head.splitlines() if line.startswith("trilat")] == printed
    monkeypatch.chdir(tmp_path)
    log = tn.simulate("free", {"control.law": "soft_law:SoftLaw"}, duration_s=0.5)
    spreads = [np.ptp([log[site].q[at, 0] for site in log.scenario.names]) for at in (0, -1)]
    assert spreads[1] < 0.6 * spreads[0]
    trilat("new", "law", "soft_law.py", cwd=tmp_path).refuses("soft_law.py", "exists")
    (tmp_path / "soft_law.py").unlink()
    trilat("new", "law", "soft_law.py", cwd=tmp_path).refuses("test_soft_law.py", "exists")
    trilat("new", "law", "numpy.py", cwd=tmp_path).refuses("Python already has a module numpy")
    trilat("new", "law", "my-law.py", cwd=tmp_path).refuses("such as mylaw.py or my_law.py")


def test_laws_compiled_anew_need_no_notice(tmp_path: Path) -> None:
    """The core is in the cache after the first run; the law is compiled by every process."""
    trilat("new", "law", "swift.py", cwd=tmp_path)
    arguments = ["sim", "two_sites", "--duration", "0.1", "--set", "control.law=swift:Swift"]
    trilat(*arguments, "-o", "first.mcap", cwd=tmp_path).succeeds()
    run = start_command(*arguments, "-o", "second.mcap", cwd=tmp_path)
    out, err = run.communicate()
    assert "second.mcap" in out
    assert "compiling" not in err


@pytest.mark.long
def test_the_test_of_the_skeleton_passes(tmp_path: Path) -> None:
    law, test = tn.new_law(tmp_path / "stiff.py")
    assert "class Stiff:" in law.read_text()
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test.name]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "4 passed" in done.stdout
    law.write_text(law.read_text().replace('remembers = ("error",)', "remembers = ()"))
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert "1 failed" in done.stdout, "a memory that does not say all is found out"
    assert "FAILED test_stiff.py::test_its_memory_is_all_that_it_keeps" in done.stdout


@pytest.mark.long
def test_reports_judge_permitted_laws_like_certify(tmp_path: Path) -> None:
    ended = trilat("new", "law", "mine.py", cwd=tmp_path)
    assert "trilat certify mine.mcap --law mine.py" in ended.out
    run = ["sim", "free", "--set", "control.law=mine:Mine", "--duration", "8"]
    trilat(*run, "-o", "mine.mcap", cwd=tmp_path).succeeds()
    allowed = ["mine.mcap", "--law", "mine.py", "--json"]
    certified = json.loads(trilat("certify", *allowed, cwd=tmp_path).out)
    (printed,) = (line for line in ended.out.splitlines() if "trilat certify" in line)
    assert trilat(*shlex.split(printed)[1:], cwd=tmp_path).code == 0
    assert trilat("certify", *allowed, cwd=tmp_path).code == 1, "settled is not stable"
    reported = json.loads(trilat("report", *allowed, cwd=tmp_path).out)
    assert certified["stability"] == "settled"
    assert reported["verdict"].startswith(certified["stability"])


@pytest.mark.parametrize(
    ("kind", "key"),
    [
        ("hand", """--set 'sites.m2.hands=[{kind="own", class="my_hand:MyHand"}]'"""),
        ("plant", "--set sites.s.plant="),
    ],
)
def test_skeletons_of_hand_and_plant_run(kind: str, key: str, tmp_path: Path) -> None:
    ended = trilat("new", kind, f"my_{kind}.py", cwd=tmp_path)
    assert ended.code == 0
    assert key in ended.out
    trilat("new", kind, f"my_{kind}.py", cwd=tmp_path).refuses(f"my_{kind}.py", "exists")
    command = next(line.strip() for line in ended.out.splitlines() if "trilat sim" in line)
    arguments = [*shlex.split(command)[1:], "--duration", "0.5"]
    ran = trilat(*arguments, cwd=tmp_path)
    assert ran.code == 0, ran.err
    assert trilat("verify", f"my_{kind}.mcap", cwd=tmp_path).code == 0


@pytest.mark.long
@pytest.mark.parametrize("kind", ["hand", "plant"])
def test_tests_of_skeletons_pass(kind: str, tmp_path: Path) -> None:
    _, test = (tn.new_hand if kind == "hand" else tn.new_plant)(tmp_path / f"own_{kind}.py")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test.name]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "passed" in done.stdout
