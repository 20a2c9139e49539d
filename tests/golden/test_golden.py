"""Logs of every released schema version stay readable, and execute to the same numbers.

`v1.mcap` is 0.4 s of `asymmetric` in virtual time, with shorter delays so that samples come into use;
`v2.mcap` has random links, a loss in bursts, an outage, a stale peer, and changes of a link and of shares;
`v3.mcap` is the same experiment, with numbered events and views; `v3-own-sines.mcap` is that again, made with
the sine and cosine that the program has had since: on its arithmetic whole runs are compared.
"""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from trilat_net.app.api import simulate
from trilat_net.core.step.fingerprint import compute_fingerprint
from trilat_net.execution.verification import TOLERANCE, verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import open_log

from .digests import COMMAND

GOLDEN = sorted(Path(__file__).parent.glob("v*.mcap"))


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_a_golden_log_is_executed_again(path: Path) -> None:
    log = open_log(path)
    verdict = verify_log(log)
    assert log.complete
    assert verdict.passed, str(verdict.first)
    assert verdict.identical == verdict.records == 1200
    assert log["s"].used["m2"][-1] > 0


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_a_golden_log_is_what_virtual_time_gives_today(path: Path) -> None:
    log = open_log(path)
    today = simulate(log.scenario)
    for site in log.sites:
        for field in ("q", "qd", "tau", "theta_hat"):
            then = getattr(log[site], field)
            now = getattr(today[site], field)
            assert np.abs(now - then).max() <= 1e3 * TOLERANCE * (1 + np.abs(then).max())
    assert not compare_with_virtual(log).late


def test_only_the_newest_has_the_arithmetic_of_today() -> None:
    same = [
        path.stem
        for path in GOLDEN
        if open_log(path).session["fingerprint"] == compute_fingerprint()
    ]
    assert same == ["v3-own-sines"]


def test_every_released_version_has_one() -> None:
    assert {path.stem for path in GOLDEN} == {"v1", "v2", "v3", "v3-own-sines"}


@pytest.mark.long
def test_a_log_with_a_users_own_law_is_executed_again() -> None:
    process = subprocess.run(
        [
            *COMMAND,
            "verify",
            "own-law.mcap",
            "--json",
            "--law",
            "spring_law.py",
            "--other-version",
        ],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    assert json.loads(process.stdout)["identical"] == 1200
