"""`trilat certify`: words, numbers, and an exit code for CI."""

import json
import re
from pathlib import Path

from tests.cli.running import simulate_by_command

from .running import trilat

PAIRS = """
name = "pairs"
rate_hz = 100
duration_s = 1.0
[link]
delay_ms = 50.0
[sites.a]
role = "master"
q0_rad = [0.3, 0.0]
[sites.b]
role = "slave"
[sites.c]
role = "master"
[sites.d]
role = "slave"
[dominance]
a = { b = 1.0 }
b = { a = 1.0 }
c = { d = 1.0 }
d = { c = 1.0 }
"""


def test_a_stable_run_exits_0(tmp_path: Path) -> None:
    file = simulate_by_command(tmp_path, "free", "rate_hz=100", seconds="30")
    output = trilat("certify", file, "--all", cwd=tmp_path).succeeds()
    facts = json.loads(trilat("certify", "--json", file, cwd=tmp_path).succeeds())
    assert (facts["verdict"], facts["passed"]) == ("covered", True)
    assert (facts["stability"], facts["reasons"], facts["roots"]["verdict"]) == (
        "stable",
        [],
        "stable",
    )
    assert output.startswith("ok   stable: converged")
    assert "ok   covered by the theorem: V did not rise: 29.78 J at 0 s, " in output
    assert "ok   this rest: stable, -0.1" in output
    assert "constant on every link: 200 ms" in output
    assert "ok   energy balance: closes to " in output
    assert "dissipated: disagreement" in output


def test_a_diverged_run_exits_1(tmp_path: Path) -> None:
    file = simulate_by_command(tmp_path, "free", "rate_hz=200", "limits.qd_limit_rad_s=0.5")
    done = trilat("certify", file, cwd=tmp_path)
    assert done.code == 1
    assert done.err == ""
    assert re.match(r"FAIL not stable: diverged: m\d joint \d reached .* at \S+ s\n", done.out)
    assert done.out.count("reached") == 1


def test_undecided_is_its_own_word_without_success(tmp_path: Path) -> None:
    done = trilat(
        "certify",
        simulate_by_command(tmp_path, "free", "rate_hz=200", "control.law=p_d", seconds="0.5"),
        cwd=tmp_path,
    )
    assert done.code == 1
    assert "open e and qd: undecided, record longer at " in done.out
    trilat("certify", "run.mcap", "--accept", "open", cwd=tmp_path).succeeds()
    assert trilat("certify", "run.mcap", "--accept", "bounded", cwd=tmp_path).code == 1
    everything = trilat("certify", "run.mcap", "--all", "--accept", "open", cwd=tmp_path)
    assert " V " not in everything.succeeds()  # p_d has no functional V


def test_closed_groups_are_named_in_text_and_json(tmp_path: Path) -> None:
    (tmp_path / "pairs.toml").write_text(PAIRS)
    trilat("sim", "pairs.toml", "-o", "run.mcap", cwd=tmp_path)
    ended = trilat("certify", "run.mcap", cwd=tmp_path)
    assert ended.code == 1
    assert (
        "V cannot be judged: {a, b} and {c, d} follow no site outside their group: beta is not unique"
        in ended.out
    )
    facts = json.loads(trilat("certify", "--json", "run.mcap", cwd=tmp_path).out)
    assert facts["closed_groups"] == [["a", "b"], ["c", "d"]]
    assert facts["functional"] is None
