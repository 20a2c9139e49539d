"""`trilat experiment run --live` with two browsers: logs verify, and what the table says is in them."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from people_builders import make_experiment_trial, read_table
from trilat_people.experiment.experiment_run import Experiment, open_experiment

from tests.live.browsers import needs_browser, page_address, wait_until_page
from tests.live.processes import Process, Stage, is_running
from tests.net.waiting import until
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log

from .participants import (
    FAR,
    REACH,
    Participant,
    begin,
    join,
    participants,
    take_part,
    write_live_protocol,
)

pytestmark = needs_browser
CONSENT = 'consent = "We record how the arms move."\nquestionnaires = [{ name = "tlx" }]\n'


def settled(running: Process, count: int) -> bool:
    return running.text().count(": succeeded after") >= count or running.ended()


def judge_log(done: Experiment, row: dict[str, Any]) -> tuple[bool, float, float]:
    """Judges a trial by the numbers of its log.

    Returns:
        Whether the trial succeeded, when its target appeared, and when the trial ended, in s.
    """
    planned = done.plan.trials[int(row["trial_number"]) - 1]
    trial = make_experiment_trial(done, planned)
    goal = trial.make_goal()
    part = open_log(done.folder / row["log"])["s"]
    arm = trial.scenario.arms["s"]
    task = done.plan.protocol.task
    places_m = np.array([arm.end_effector(q) for q in part.q])
    inside = np.linalg.norm(places_m - goal.find_target_m(1e3), axis=1) <= goal.width_m / 2.0
    inside &= part.t_s >= goal.appears_s
    outside = np.concatenate([[-1], np.flatnonzero(~inside)])
    since = outside[np.searchsorted(outside, np.arange(len(inside)), side="right") - 1] + 1
    dwelt = inside & (part.t_s - part.t_s[np.minimum(since, len(inside) - 1)] >= task.dwell_s)  # type: ignore[union-attr]
    late = part.t_s >= goal.appears_s + task.longest_s
    ended = np.flatnonzero(dwelt | late)[0]
    return bool(dwelt[ended]), goal.appears_s, float(part.t_s[ended])


def assert_log_table_and_page_agree(
    folder: Path, people: list[Participant], running: Process
) -> None:
    """Asserts that the logs, the table and what the participants were told agree."""
    done = open_experiment(folder)
    rows = read_table(folder)
    assert len(rows) == len(done.plan.trials)
    assert len(list((folder / "logs").iterdir())) == len(rows)
    for n, row in enumerate(rows):
        log = open_log(folder / row["log"])
        assert verify_log(log).passed
        succeeded, appears_s, ended_s = judge_log(done, row)
        assert (row["succeeded"], float(row["completion_s"])) == (
            str(int(succeeded)),
            ended_s - appears_s,
        )
        assert f"P1, P2, condition {row['condition']}" in log.scenario.about
        assert done.plan.digest in log.scenario.about
        marks = [event.text for event in log.events if event.kind == "mark"]
        number = row["trial_number"]
        end = f"trial {number} succeeded" if succeeded else f"trial {number} failed"
        assert marks == [f"trial {number} begins", "target appears", end]
        for user in ("m1", "m2"):
            assert log[user].hand[:, 0].max() > 0.5  # both took hold
        feedback = {
            "completion_s": f"{float(row['completion_s']):.2f} s",
            "error_end_mm": f"{float(row['error_end_mm']):.1f} mm",
        }
        for person in people:
            assert person.feedback[n] == feedback
    assert sum(row["succeeded"] == "1" for row in rows) > len(rows) // 2
    assert "Traceback" not in running.text()


@pytest.mark.long
@pytest.mark.parametrize("trials", [3, 10])
def test_two_people_reach_together_as_logged(trials: int, stage: Stage) -> None:
    """Two browsers, two roles, real pointers: boundaries and measures are those of verified logs."""
    folder = stage.folder / "out"
    conditions = FAR if trials % 2 == 0 else ""
    count = trials // (2 if conditions else 1)
    running = begin(
        stage,
        write_live_protocol(stage.folder, count, CONSENT, conditions),
        "--out",
        str(folder),
    )
    with participants(running) as people:
        take_part(people, running.ended, 60.0 * trials)
        assert people[0].page.inner_text("#sheet h2") == "That was all. Thank you."
    assert running.code() == 0, running
    assert_log_table_and_page_agree(folder, people, running)
    answers = read_table(folder, "questionnaires.csv")
    assert {(row["participant"], row["item"]) for row in answers} >= {
        ("P1", "mental"),
        ("P2", "effort"),
    }
    assert {row["event"] for row in read_table(folder, "events.csv")} == {
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
    folder = stage.folder / "out"
    pictures = os.environ.get("TRILAT_PICTURES")
    running = begin(
        stage, write_live_protocol(stage.folder, 1, task=task), "--out", str(folder)
    )
    with participants(running) as people:
        for person in people:
            person.beyond_m = 0.02 if what == "press" else 0.0  # which presses with about 4 N
        take_part(people, lambda: people[0].look().get("appeared"))
        if pictures:
            for person in people:
                person.page.screenshot(path=f"{pictures}/{what}_{person.site}.png")
        pages = [person.look() for person in people]
        take_part(people, running.ended)
    assert running.code() == 0, running
    (row,) = read_table(folder)
    protocol = open_experiment(folder).plan.protocol
    instructions = protocol.task.render_instructions("s")
    assert [page["task"] for page in pages] == [instructions, instructions]
    assert ("way" in pages[0]) == (what == "carry")
    assert (pages[0]["target"]["at"] != pages[1]["target"]["at"]) == (what == "settle")
    assert row["succeeded"] == "1", row
    assert float(row[measure]) >= 0.0
    assert verify_log(open_log(folder / row["log"])).passed


@pytest.mark.long
def test_a_killed_experiment_with_people_resumes_whole(stage: Stage) -> None:
    """SIGKILL within a trial and between two, a page reloaded within one: nothing twice, nothing lost."""
    folder = stage.folder / "out"
    first = begin(stage, write_live_protocol(stage.folder, 2, CONSENT), "--out", str(folder))
    with participants(first) as people:
        take_part(people, lambda: all(person.look().get("running") for person in people))
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
    assert [row["trial_number"] for row in read_table(folder)] == ["1", "2"]
    assert len(list((folder / "logs").iterdir())) == 2
    aborted = [row for row in read_table(folder, "events.csv") if row["event"] == "aborted"]
    assert [row["text"] for row in aborted] == ["the program was ended"]
    assert sum(row["event"] == "consent" for row in read_table(folder, "events.csv")) == 2
    journal = (folder / "trials.journal").read_bytes()
    assert len([line for line in journal.split(b"\n") if b'"cell"' in line]) == 2


@pytest.mark.long
def test_a_stopped_trial_is_repeated(stage: Stage) -> None:
    """A user stops one, closes the page in another; a second page of the role only watches."""
    folder = stage.folder / "out"
    # nobody dwells so long that a trial succeeds before it is stopped
    task = REACH.replace("dwell_s = 0.2", "dwell_s = 8.0")
    running = begin(
        stage, write_live_protocol(stage.folder, 1, task=task), "--out", str(folder)
    )
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
    events = [
        row["text"] for row in read_table(folder, "events.csv") if row["event"] == "aborted"
    ]
    assert events == ["m1 stopped it", "the page of m2 is gone"]
    assert len(list((folder / "tries").iterdir())) == 2  # their logs are kept aside
    assert len(read_table(folder)) == 1


@pytest.mark.long
def test_experimenters_may_interrupt_and_resume(stage: Stage) -> None:
    folder = stage.folder / "out"
    running = begin(stage, write_live_protocol(stage.folder, 2), "--out", str(folder))
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
