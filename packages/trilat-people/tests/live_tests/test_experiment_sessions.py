"""`trilat experiment run --live` with two browsers: logs verify, and what the table says is in them."""

import csv
import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trilat_people.experiment.experiment_run import Experiment, open_experiment
from trilat_people.experiment.trial_run import ExperimentTrial

from tests.live.browsers import needs_browser, page_address, wait_until_page
from tests.live.processes import Process, Stage, is_running
from tests.net.waiting import until
from trilat_net.execution.verification import verify
from trilat_net.log.log_reader import open_log

from .participants import (
    FAR,
    REACH,
    Participant,
    begin,
    join,
    participants,
    take_part,
    write_protocol,
)

pytestmark = needs_browser
CONSENT = 'consent = "We record how the arms move."\nquestionnaires = [{ name = "tlx" }]\n'


def settled(running: Process, count: int) -> bool:
    return running.text().count(": succeeded after") >= count or running.ended()


def rows_of(folder: Path, name: str = "trials.csv") -> list[dict[str, str]]:
    with (folder / name).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def judged_again(done: Experiment, row: dict[str, Any]) -> tuple[bool, float, float]:
    """Whether it succeeded, when the target appears and when the trial ends, by the log's numbers alone."""
    planned = done.plan.trials[int(row["trial_number"]) - 1]
    scenario = done.plan.scenarios[planned.condition]
    goal = ExperimentTrial(done.plan.protocol, scenario, planned, done.plan.digest).make_goal()
    part = open_log(done.folder / row["log"])["s"]
    arm, task = scenario.arms["s"], done.plan.protocol.task
    at_m = np.array([arm.end_effector(q) for q in part.q])
    inside = np.linalg.norm(at_m - goal.find_target_m(1e3), axis=1) <= goal.width_m / 2.0
    inside &= part.t_s >= goal.appears_s
    left = np.concatenate([[-1], np.flatnonzero(~inside)])
    since = left[np.searchsorted(left, np.arange(len(inside)), side="right") - 1] + 1
    dwelt = inside & (part.t_s - part.t_s[np.minimum(since, len(inside) - 1)] >= task.dwell_s)  # type: ignore[union-attr]
    late = part.t_s >= goal.appears_s + task.longest_s
    ended = np.flatnonzero(dwelt | late)[0]
    return bool(dwelt[ended]), goal.appears_s, float(part.t_s[ended])


def assert_log_table_and_page_agree(
    folder: Path, people: list[Participant], running: Process
) -> None:
    done, rows = open_experiment(folder), rows_of(folder)
    assert len(rows) == len(done.plan.trials)
    assert len(list((folder / "logs").iterdir())) == len(rows)
    for n, row in enumerate(rows):
        log = open_log(folder / row["log"])
        assert verify(log).passed
        succeeded, appears_s, ended_s = judged_again(done, row)
        assert (row["succeeded"], float(row["completion_s"])) == (
            str(int(succeeded)),
            ended_s - appears_s,
        )
        assert f"P1, P2, condition {row['condition']}" in log.scenario.about
        assert done.plan.digest in log.scenario.about
        marks = [event.text for event in log.events if event.kind == "mark"]
        number = row["trial_number"]
        how = "succeeded" if succeeded else "failed"
        assert marks == [f"trial {number} begins", "target appears", f"trial {number} {how}"]
        assert log["m1"].hand[:, 0].max() > 0.5 < log["m2"].hand[:, 0].max()  # both took hold
        told = {
            "completion_s": f"{float(row['completion_s']):.2f} s",
            "error_end_mm": f"{float(row['error_end_mm']):.1f} mm",
        }
        assert all(one.told[n] == told for one in people), (n, people[0].told, told)
    assert sum(row["succeeded"] == "1" for row in rows) > len(rows) // 2
    assert "Traceback" not in running.text()


@pytest.mark.long
@pytest.mark.parametrize("trials", [3, 10])
def test_two_people_reach_together_as_logged(trials: int, stage: Stage) -> None:
    """Two browsers, two roles, real pointers: boundaries and measures are those of verified logs."""
    folder, conditions = stage.folder / "out", FAR if trials % 2 == 0 else ""
    count = trials // (2 if conditions else 1)
    running = begin(
        stage, write_protocol(stage.folder, count, CONSENT, conditions), "--out", str(folder)
    )
    with participants(running) as people:
        take_part(people, running.ended, 60.0 * trials)
        assert people[0].page.inner_text("#sheet h2") == "That was all. Thank you."
    assert running.code() == 0, running
    assert_log_table_and_page_agree(folder, people, running)
    answers = rows_of(folder, "questionnaires.csv")
    assert {(row["participant"], row["item"]) for row in answers} >= {
        ("P1", "mental"),
        ("P2", "effort"),
    }
    assert {row["event"] for row in rows_of(folder, "events.csv")} == {
        "consent",
        "questionnaire",
    }


TRACK = 'kind = "track"\nduration_s = 5.0\namplitude_m = 0.05\nwidth_m = 0.1\napart_m = 0.1'
CONTACT = """kind = "contact"
distance_m = 0.04
force_n = 4.0
tolerance_n = 3.0
dwell_s = 0.5
timeout_s = 20.0
"""
TASKS = {
    "carry": (f"{REACH}corridor_m = 1.0", "internal_rms_n"),
    "hand over": (f"{REACH}handover_s = 4.0", "error_handover_mm"),
    "settle": (TRACK, "first_settled"),
    "press": (CONTACT, "wall_force_n"),
}
"""What else two users are asked for, and what is measured of it."""


@pytest.mark.long
@pytest.mark.parametrize("what", TASKS)
def test_two_people_perform_other_tasks(what: str, stage: Stage) -> None:
    """They are told, it is drawn, and the table has its measure; the log verifies."""
    task, measure = TASKS[what]
    folder, pictures = stage.folder / "out", os.environ.get("TRILAT_PICTURES")
    running = begin(stage, write_protocol(stage.folder, 1, task=task), "--out", str(folder))
    with participants(running) as people:
        for one in people:
            one.beyond_m = 0.006 if what == "press" else 0.0  # the target is a millimetre deep
        take_part(people, lambda: people[0].look().get("appeared"))
        for one in people if pictures else ():
            one.page.screenshot(path=f"{pictures}/{what}_{one.site}.png")
        shown = [one.look() for one in people]
        take_part(people, running.ended)
    assert running.code() == 0, running
    done, (row,) = open_experiment(folder), rows_of(folder)
    asked = done.plan.protocol.task.render_instructions("s")
    assert [one["task"] for one in shown] == [asked, asked]
    assert ("way" in shown[0]) == (what == "carry")
    assert (shown[0]["target"]["at"] != shown[1]["target"]["at"]) == (what == "settle")
    assert row["succeeded"] == "1", row
    assert float(row[measure]) >= 0.0
    assert verify(open_log(folder / row["log"])).passed


@pytest.mark.long
def test_a_killed_experiment_with_people_resumes_whole(stage: Stage) -> None:
    """SIGKILL within a trial and between two, a page reloaded within one: nothing twice, nothing lost."""
    folder = stage.folder / "out"
    first = begin(stage, write_protocol(stage.folder, 2, CONSENT), "--out", str(folder))
    with participants(first) as people:
        take_part(people, lambda: all(one.look().get("running") for one in people))
        left = first.children()
        assert left
        first.signal(signal.SIGKILL)
        first.code()
        until(lambda: not any(map(is_running, left)))
    second = begin(stage, folder, name="second")
    with participants(second) as people:
        take_part(people, lambda: people[0].look().get("appeared"))
        people[0].page.mouse.up()
        people[0].page.reload()
        wait_until_page(
            people[0].page, "trilat.frame?.stage.left_s > 0"
        )  # it is in the trial again
        take_part(people, lambda: settled(second, 1))
        left = second.children()
        second.signal(signal.SIGKILL)
        second.code()
        until(lambda: not any(map(is_running, left)))
    third = begin(stage, folder, name="third")
    with participants(third) as people:
        take_part(people, third.ended)
    assert third.code() == 0, third
    assert [row["trial_number"] for row in rows_of(folder)] == ["1", "2"]
    assert len(list((folder / "logs").iterdir())) == 2
    aborted = [row for row in rows_of(folder, "events.csv") if row["event"] == "aborted"]
    assert [row["text"] for row in aborted] == ["the program was ended"]
    assert sum(row["event"] == "consent" for row in rows_of(folder, "events.csv")) == 2
    journal = (folder / "trials.journal").read_bytes()
    assert len([line for line in journal.split(b"\n") if b'"cell"' in line]) == 2


@pytest.mark.long
def test_a_stopped_trial_is_repeated(stage: Stage) -> None:
    """A user stops one, closes the page in another; a second page of the role only watches."""
    folder = stage.folder / "out"
    # nobody dwells so long that a trial succeeds before it is stopped
    task = REACH.replace("dwell_s = 0.2", "dwell_s = 8.0")
    running = begin(stage, write_protocol(stage.folder, 1, task=task), "--out", str(folder))
    with participants(running) as people:
        other = people[0].page.context.new_page()
        other.goto(people[0].page.url)
        other.wait_for_selector("text=Another page of this user is open")
        other.close()
        take_part(people, lambda: people[0].look().get("appeared"))
        people[0].page.mouse.up()  # a mouse that holds an arm presses no button
        people[0].page.click("text=stop this trial")
        running.prints("must be repeated: m1 stopped it")
        people[1].page.wait_for_selector("text=This trial is made again: m1 stopped it.")
        take_part(people, lambda: people[0].look().get("appeared"))
        people[1].page.context.close()
        running.prints("must be repeated: the page of m2 is gone")
        browser = people[0].page.context.browser
        assert browser is not None
        take_part([people[0], join(browser, running, "m2")], running.ended)
    assert running.code() == 0, running
    events = [row["text"] for row in rows_of(folder, "events.csv") if row["event"] == "aborted"]
    assert events == ["m1 stopped it", "the page of m2 is gone"]
    assert len(list((folder / "tries").iterdir())) == 2  # their logs are kept aside
    assert len(rows_of(folder)) == 1


@pytest.mark.long
def test_experimenters_may_interrupt_and_resume(stage: Stage) -> None:
    folder = stage.folder / "out"
    running = begin(stage, write_protocol(stage.folder, 2), "--out", str(folder))
    with participants(running) as people:
        experimenter = people[0].page.context.new_page()
        experimenter.on("dialog", lambda dialog: dialog.accept())
        experimenter.goto(page_address(running))
        take_part(people, lambda: settled(running, 1))
        wait_until_page(experimenter, "trilat.hello.stage.condition === 'near'")
        experimenter.click("#end")
        assert running.code() == 0, running
    assert "1 of 2 trials" in running.text()
    status = stage.start("status", "experiment", "status", str(folder), "--json")
    assert status.code() == 0
    assert json.loads(status.text())["done"] == 1
    synthetic = stage.start("synthetic", "experiment", "run", str(folder))
    assert synthetic.code() == 2
    assert "the finished trials were done by people" in " ".join(synthetic.text().split())
