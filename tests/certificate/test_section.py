"""What the report, a terminal and a program are told of a certificate."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.analysis import logs
from trilat_net.analysis.report import write_report
from trilat_net.certificate.certificate import certify
from trilat_net.certificate.facts import facts
from trilat_net.certificate.figure import functional_over_time
from trilat_net.certificate.section import section
from trilat_net.certificate.words import sentences
from trilat_net.log.reader import Log

from . import runs


def jittered() -> Log:
    return runs.log("free", {**runs.JITTER, "rate_hz": 100})


LOGS = {
    "free": lambda: runs.log("free", {"duration_s": 4.0, "rate_hz": 200}),
    "jitter": jittered,
    "rich": lambda: runs.log("rich"),
    "four": lambda: logs.simulated("four"),
    "p_d": lambda: runs.log("free", {"control.law": "p_d", "duration_s": 1.0, "rate_hz": 200}),
    "empty": lambda: logs.rewritten(logs.simulated("paper"), lambda _: False),
    "diverged": logs.diverged,
    "busy": lambda: logs.busy().log,
}


@pytest.mark.parametrize("name", LOGS)
def test_facts_are_json_without_nan_and_say_what_the_verdict_says(name: str) -> None:
    found = certify(LOGS[name]())
    read = json.loads(json.dumps(facts(found), allow_nan=False))
    assert read["text"] == found.verdict.text
    assert read["passed"] is found.passed
    assert (read["functional"] is None) == (found.balance is None)
    assert (read["rise"] is None) == (found.verdict.rise is None)
    assert all(set(premise) == {"name", "holds", "text"} for premise in read["premises"])


def test_the_numbers_add_up() -> None:
    """V at the end is V at the start, less what was taken, plus what was given, to the residual."""
    f = facts(certify(LOGS["jitter"]()))["functional"]
    end = f["v_first_j"] - sum(f["taken_j"].values()) + sum(f["given_j"].values())
    assert end == pytest.approx(f["v_last_j"], abs=f["residual_max_j"])
    assert sum(f["parts_last_j"].values()) == pytest.approx(f["v_last_j"])


@pytest.mark.parametrize("name", LOGS)
def test_a_figure_is_a_function_of_the_log(name: str) -> None:
    log = LOGS[name]()
    found = certify(log)
    figure = functional_over_time(log, found)
    if found.balance is None:
        assert [text.get_text() for text in figure.texts] == [found.verdict.text]
        return
    assert [axes.get_ylabel()[-3:] for axes in figure.axes] == ["(J)"] * 4
    assert figure.axes[-1].get_xlabel() == "time (s)"
    assert figure.axes[-1].get_yscale() == "log"
    total = figure.axes[0].lines[0]
    assert np.max(total.get_ydata()) == pytest.approx(found.balance.V.max())
    marked = [p for p in figure.axes[0].patches if p.get_zorder() == 0.4]
    assert len(marked) == (found.verdict.rise is not None)


def test_the_report_shows_it_in_one_file(tmp_path: Path) -> None:
    log = jittered()
    page, numbers, *figures = write_report(log, tmp_path, sections=[section(log)])
    html = page.read_text(encoding="utf-8")
    assert "Was it stable, and why" in html
    assert "outside the theorem (delays): V rose by" in html
    assert 'src="data:image/png;base64,' in html
    assert tmp_path / "certificate.png" in figures
    assert json.loads(numbers.read_text())["certificate"]["verdict"] == "rose"


def test_sentences_give_verdict_balance_and_growth() -> None:
    said = sentences(certify(LOGS["free"]()))
    assert [line.split(":")[0] for line in said] == ["certificate", "energy balance", "e and qd"]
    assert "once sampling is accounted for" in said[1]
    assert len(sentences(certify(LOGS["p_d"]()))) == 2


def test_no_energy_is_said() -> None:
    rest = {"control.theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0], "duration_s": 0.5, "rate_hz": 200}
    assert sentences(certify(runs.log("paper", rest)))[1] == "energy balance: there is no energy in this run"
