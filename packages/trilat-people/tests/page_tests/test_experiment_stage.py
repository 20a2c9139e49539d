"""An experiment with people, without browsers: whose word counts, and what a folder holds after any end."""

import csv
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from trilat_people.experiment.experiment_analysis import analyse_experiment
from trilat_people.experiment.experiment_run import (
    Experiment,
    begin_experiment,
    open_experiment,
)
from trilat_people.experiment.trial_run import ExperimentTrial, SyntheticTrial, TrialJudge
from trilat_people.live_page.experiment_stage import (
    END_DELAY_NS,
    MAX_ABSENCE_NS,
    Stage,
    TrialWatch,
)
from trilat_people.live_page.page_orders import AbortTrial, DoStep
from trilat_people.live_page.page_server import PageServer

from tests.experiments import APART, REACH, write_protocol
from tests.live.page_client import page_client, with_query
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from tests.net.waiting import until
from trilat_net.analysis.certificate.running_energy import RecordWindow
from trilat_net.app.demo_session import SessionResult
from trilat_net.core.step.ticks import NS_PER_S
from trilat_net.errors import LogRefused, UsageError
from trilat_net.execution.verification import verify
from trilat_net.log.log_reader import open_log
from trilat_net.net.clock import SystemClock

from .people import NO_SESSION, Killed, People

ASKS = """
trials = 1
consent = "We record how the arms move."
questionnaires = [
  { name = "tlx" },
  { name = "trust", after = "experiment", items = { it = "I trusted it." }, most = 50 },
]
rest_s = 30
feedback = ["completion_s"]
"""


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    file = write_protocol(tmp_path, '["m1", "m2"]')
    file.write_text(
        file.read_text(encoding="utf-8").replace("trials = 2\n", ASKS), encoding="utf-8"
    )
    return begin_experiment(file, tmp_path / "out")


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock(1)


@pytest.fixture
def stage(experiment: Experiment, clock: ManualClock) -> Stage:
    return Stage(experiment.plan, clock)


def rows_of(experiment: Experiment, name: str) -> list[dict[str, str]]:
    with (experiment.folder / name).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def assert_whole(experiment: Experiment) -> None:
    """Every trial is there once, by a log that verifies and of which the table has the digest."""
    rows = open_experiment(experiment.folder).to_rows()
    assert [row["trial_number"] for row in rows] == [1, 2]
    assert {row["people"] for row in rows} == {1}
    assert all(verify(open_log(experiment.folder / row["log"])).passed for row in rows)
    assert len(list((experiment.folder / "logs").iterdir())) == 2
    answers = [
        (row["participant"], row["block"], row["item"])
        for row in rows_of(experiment, "questionnaires.csv")
    ]
    assert len(set(answers)) == len(answers) == 2 * (2 * 6 + 1)
    assert [
        row["who"] for row in rows_of(experiment, "events.csv") if row["event"] == "consent"
    ] == [
        "P1",
        "P2",
    ]


def test_people_are_asked_in_plan_order(experiment: Experiment) -> None:
    people = People(experiment)
    assert people.run()
    asked = list(dict.fromkeys(key for _, key in people.steps))
    assert asked == [
        "consent 1",
        "trial 1",
        "questionnaire 1 tlx",
        "trial 2",
        "questionnaire 2 tlx",
        "questionnaire 2 trust",
    ]
    assert {site for site, _ in people.steps} == {"m1", "m2"}
    assert_whole(experiment)
    assert people.monotonic_ns() > 30 * NS_PER_S  # they have rested between two blocks
    assert people.stage.describe("user", "m1", 0, None)["phase"] == "over"
    told = people.stage.describe("user", "m1", 0, None)["told"]
    assert told["measures"] == {"completion_s": experiment.to_rows()[-1]["completion_s"]}
    found = analyse_experiment(experiment.folder)
    assert {one.mean for one in found.means.get("tlx", [])} <= {40.0}


def killed_in(when: str, number: int) -> Any:
    def fault(watch: TrialWatch, folder: Path) -> SessionResult | None:
        if watch.trial.planned.number == number:
            if when == "the session":
                (folder / "run.mcap.active").write_bytes(b"half")
            raise Killed
        return None

    return fault


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("when", ["the session", "its start"])
def test_a_killed_program_resumes_at_the_trial(
    when: str, number: int, experiment: Experiment
) -> None:
    with pytest.raises(Killed):
        People(experiment).run(killed_in(when, number))
    again = People(open_experiment(experiment.folder))
    assert again.run()
    assert ("m1", "consent 1") not in again.steps
    assert_whole(experiment)
    aborted = [
        row["text"] for row in rows_of(experiment, "events.csv") if row["event"] == "aborted"
    ]
    assert aborted == (["the program was ended"] if when == "the session" else [])


def test_trials_with_finished_logs_survive_a_kill(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(ExperimentTrial, "settle", killed)
        patch.setattr(SyntheticTrial, "settle", lambda *_, **__: None)
        with pytest.raises(Killed):
            People(experiment).run()
    (path,) = (experiment.folder / "logs").iterdir()
    before = path.read_bytes()
    again = People(open_experiment(experiment.folder))
    assert again.run()
    assert ("m1", "trial 1") not in again.steps
    assert path.read_bytes() == before
    assert_whole(experiment)


def test_a_full_disk_is_reported_and_loses_nothing(experiment: Experiment) -> None:
    def full(watch: TrialWatch, folder: Path) -> SessionResult | None:
        problems = ["recorder ended with code 5: No space left on device"]
        second = watch.trial.planned.number == 2
        return (
            SessionResult(folder / "run.mcap", problems, exit_code=LogRefused.exit_code)
            if second
            else None
        )

    with pytest.raises(LogRefused, match="No space left"):
        People(experiment).run(full)
    assert len(open_experiment(experiment.folder).to_rows()) == 1
    assert People(open_experiment(experiment.folder)).run()
    assert_whole(experiment)


@pytest.mark.parametrize("step_ns", [-(10**13), 10**13])
def test_stepping_wall_clocks_change_only_note_times(
    step_ns: int, experiment: Experiment
) -> None:
    people = People(experiment)

    def steps(watch: TrialWatch, _: Path) -> None:
        people.wall_ns = step_ns * (watch.trial.planned.number == 1)

    assert people.run(steps)
    assert_whole(experiment)
    assert people.monotonic_ns() < 120 * NS_PER_S


def test_aborted_trials_are_kept_aside_and_repeated(experiment: Experiment) -> None:
    tries: list[str] = []

    def stops(watch: TrialWatch, folder: Path) -> SessionResult | None:
        tries.append(folder.name)
        if len(tries) > 1:
            return None
        watch.aborted = "m1 stopped it"
        (folder / "run.mcap").write_bytes(b"of the try that was stopped")
        return SessionResult(folder / "run.mcap")

    people = People(experiment)
    assert people.run(stops)
    assert tries == ["00001-01", "00001-02", "00002-01"]
    assert (experiment.folder / "tries" / "00001-01" / "run.mcap").exists()
    assert "trial 1 must be repeated: m1 stopped it" in people.said
    assert_whole(experiment)


def test_logs_that_end_early_do_not_count(experiment: Experiment) -> None:
    trial = ExperimentTrial(
        experiment.plan.protocol,
        experiment.plan.scenarios["near"],
        experiment.plan.trials[0],
        experiment.plan.digest,
    )
    assert TrialJudge(trial).accept(0.0, [-0.6, 1.2], [0.0, 0.0]) is None
    people = People(experiment)
    left: list[int] = [1]

    def breaks(_: TrialWatch, folder: Path) -> SessionResult | None:
        if not left:
            return None
        left.clear()
        (folder / "run.mcap").write_bytes(b"no log")
        return SessionResult(folder / "run.mcap")

    assert people.run(breaks)
    assert (experiment.folder / "tries" / "00001-01").is_dir()
    assert_whole(experiment)


def test_people_and_models_share_no_folder(experiment: Experiment) -> None:
    people = People(experiment)
    people.run(lambda watch, _: setattr(people, "ends", watch.trial.planned.number == 1))
    with pytest.raises(
        UsageError, match="the finished trials were done by people: continue with"
    ):
        open_experiment(experiment.folder).run(jobs=1)


def first_trial(experiment: Experiment) -> Any:
    return next(step for step in experiment.plan.list_steps() if step.kind == "trial")


def test_first_page_of_a_role_speaks_for_it(experiment: Experiment, stage: Stage) -> None:
    asked = stage.request_step(first_trial(experiment))
    stage.poll(NO_SESSION, [("m1", 7), ("m1", 9), ("m2", 8)])
    ready = DoStep(key="trial 1")
    assert not stage.accept("m1", 9, ready)
    assert not stage.accept("m1", 7, DoStep(key="trial 2"))
    assert not stage.accept("", 3, ready)
    assert stage.accept("m1", 7, ready)
    assert asked.replies.keys() == {"m1"}
    assert stage.describe("user", "m1", 9, None)["second"]
    assert not stage.describe("user", "m1", 7, None)["second"]
    stage.poll(NO_SESSION, [("m1", 9), ("m2", 8)])  # who leaves is not ready any more
    assert not asked.replies
    assert stage.accept("m1", 9, ready)


def test_answers_are_those_of_the_scale(experiment: Experiment, stage: Stage) -> None:
    step = next(one for one in experiment.plan.list_steps() if one.kind == "questionnaire")
    asked = stage.request_step(step)
    stage.poll(NO_SESSION, [("m1", 1), ("m2", 2)])
    for answers in ([], [40.0] * 5, [41.0] * 6, [105.0] * 6, [-5.0] * 6):
        assert not stage.accept("m1", 1, DoStep(key=step.key, answers=answers))
    assert stage.accept(
        "m1", 1, DoStep(key=step.key, answers=[0.0, 100.0, 5.0, 50.0, 60.0, 95.0])
    )
    assert asked.replies["m1"][0]["physical"] == 100.0
    assert stage.accept(
        "m2", 2, DoStep(key=step.key, answers=[0.0, None, 5.0, None, 60.0, 95.0])
    )
    assert asked.replies["m2"][0]["physical"] is None  # a slider that nobody touched


def test_users_are_not_told_the_condition(experiment: Experiment, stage: Stage) -> None:
    stage.request_step(first_trial(experiment))
    stage.poll(NO_SESSION, [("m1", 1)])
    shown = {
        who: stage.describe(who, site, 1, None)
        for who, site in (("user", "m1"), ("experimenter", ""))
    }
    assert "near" not in str(shown["user"])
    assert shown["experimenter"]["condition"] == "near"
    assert [one["state"] for one in shown["user"]["users"]] == ["here", ""]


@pytest.fixture
def watched(experiment: Experiment, tmp_path: Path) -> tuple[Any, Any, Any]:
    """A trial, its entry by its log, and the records of its slave."""
    plan = experiment.plan
    trial = SyntheticTrial(plan.protocol, plan.scenarios["near"], plan.trials[0], plan.digest)
    entry = trial.write(tmp_path / "log.mcap")
    return trial, entry, open_log(tmp_path / "log.mcap")


def view_of(trial: ExperimentTrial, log: Any, last: int, mode: str = "run") -> Any:
    window = RecordWindow(trial.scenario, "s", kept_s=60.0)
    for record in log["s"].states[: last + 1]:
        window.receive(record)
    site = SimpleNamespace(window=window, complete=last, record=SimpleNamespace(mode=mode))
    return SimpleNamespace(running=True, sites={"s": site})


def test_users_see_own_target_and_corridor(tmp_path: Path, clock: ManualClock) -> None:
    def shown(task: str, site: str) -> Any:
        (folder := tmp_path / task[-3:] / (site or "-")).mkdir(parents=True)
        plan = begin_experiment(
            write_protocol(folder, '["m1", "m2"]', task), folder / "out"
        ).plan
        trial = ExperimentTrial(
            plan.protocol, plan.scenarios["near"], plan.trials[0], plan.digest
        )
        return TrialWatch(trial, clock).describe(trial.appears_s + 0.5, site)

    first, second, middle = (shown(APART, site)["target"]["at"] for site in ("m1", "m2", ""))
    assert first[0] - second[0] == pytest.approx(0.1)
    assert middle[0] == pytest.approx(0.5 * (first[0] + second[0]))
    carried = shown(f"{REACH}\ncorridor_m = 0.03", "m1")
    assert carried["way"]["width_m"] == 0.03
    assert carried["way"]["from"] != carried["target"]["at"]
    assert "way" not in shown(REACH, "m1")


def test_watch_judges_as_the_log_does(watched: Any, clock: ManualClock) -> None:
    trial, entry, log = watched
    watch, moments = TrialWatch(trial, clock), []
    for last in range(3, len(log["s"]), 17):
        moments += watch.poll(view_of(trial, log, last), ())
    assert watch.judge.outcome is not None
    assert watch.judge.outcome.succeeded == entry.succeeded
    assert watch.judge.outcome.ended_s - trial.appears_s == entry.measures["completion_s"]
    assert moments == ["trial 1 begins", "target appears", "trial 1 succeeded"]
    assert not watch.over
    clock.sleep_until(clock.monotonic_ns() + END_DELAY_NS + 1)
    assert watch.over


def test_a_stopped_arm_ends_the_trial(watched: Any, clock: ManualClock) -> None:
    trial, _, log = watched
    watch = TrialWatch(trial, clock)
    assert watch.poll(view_of(trial, log, 5, "stopped"), ()) == ["trial 1 aborted: s stopped"]
    assert watch.over


def test_an_absent_page_ends_the_trial(
    experiment: Experiment, stage: Stage, watched: Any
) -> None:
    trial, _, log = watched
    clock = stage._clock
    stage.request_step(first_trial(experiment))
    both = [("m1", 1), ("m2", 2)]
    stage.poll(NO_SESSION, both)
    watch = TrialWatch(trial, clock)
    stage.show_trial(watch)
    for pages, passed_ns in (
        (both, 0),
        (both[:1], MAX_ABSENCE_NS // 2),
        ([("m1", 1), ("m2", 3)], 1),
        (both[:1], 1),
    ):
        clock.sleep_until(clock.monotonic_ns() + passed_ns)
        stage.poll(view_of(trial, log, 5), pages)
        assert not watch.aborted  # a page that was reloaded is back in time
    clock.sleep_until(clock.monotonic_ns() + MAX_ABSENCE_NS + 1)
    stage.poll(view_of(trial, log, 5), both[:1])
    assert watch.aborted == "the page of m2 is gone"


def test_users_and_experimenters_stop_a_trial(stage: Stage, watched: Any) -> None:
    trial, _, _ = watched
    for site, page, whose in (("m1", 1, "m1"), ("", 9, "the experimenter")):
        stage.poll(NO_SESSION, [("m1", 1), ("m1", 5)])
        watch = TrialWatch(trial, stage._clock)
        stage.show_trial(watch)
        assert not stage.accept("m1", 5, AbortTrial())
        assert stage.accept(site, page, AbortTrial(why="it is too hot"))
        assert watch.aborted == f"{whose} stopped it: it is too hot"
        assert not stage.accept(site, page, AbortTrial())


def test_server_turns_from_session_to_session(experiment: Experiment) -> None:
    """A user's page answers for its own site; each session greets every page anew."""
    clock, network = SystemClock(), LocalNetwork()
    stage = Stage(experiment.plan, clock)
    asked = stage.request_step(first_trial(experiment))
    with (
        PageServer(network.join(), clock, "idle", stage=stage) as server,
        page_client(with_query(server.address, "as=m1")) as user,
        page_client(with_query(server.address, "watch")) as watcher,
    ):
        user.take()
        assert user.hello["stage"]["who"] == "P1"
        watcher.take()
        watcher.send(do="step", key="trial 1")
        until(lambda: server.refused["not of its role"] == 1)
        user.send(do="step", key="consent 1")
        until(lambda: server.refused["was not asked"] == 1)
        user.send(do="step", key="trial 1")
        until(lambda: "m1" in asked.replies)
        server.show(network.join(), "another")
        assert server.view.session == "another"
        until(lambda: user.take() == {} and user.hello["session"] == "another")
