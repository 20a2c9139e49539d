"""An experiment with people, without browsers: whose word counts, and what a folder holds after any end."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from people_builders import (
    NO_SESSION,
    PAIR,
    Killed,
    People,
    make_experiment_trial,
    read_table,
    replace_text,
)
from trilat_people.experiment.experiment_analysis import analyse_experiment
from trilat_people.experiment.experiment_run import Experiment, open_experiment
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
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log
from trilat_net.net.clock import SystemClock

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
    """An experiment of a pair with two trials, consent, questionnaires and rest."""
    file = replace_text(write_protocol(tmp_path, PAIR), "trials = 2\n", ASKS)
    return Experiment.begin(file, tmp_path / "out")


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock(1)


@pytest.fixture
def stage(experiment: Experiment, clock: ManualClock) -> Stage:
    return Stage(experiment.plan, clock)


def assert_whole(experiment: Experiment) -> None:
    """Asserts that a folder has each trial once, with a verified log, and all answers once."""
    rows = open_experiment(experiment.folder).to_rows()
    assert [row["trial_number"] for row in rows] == [1, 2]
    assert {row["people"] for row in rows} == {1}
    assert all(verify_log(open_log(experiment.folder / row["log"])).passed for row in rows)
    assert len(list((experiment.folder / "logs").iterdir())) == 2
    answers = [
        (row["participant"], row["block"], row["item"])
        for row in read_table(experiment.folder, "questionnaires.csv")
    ]
    assert len(set(answers)) == len(answers) == 2 * (2 * 6 + 1)
    events = read_table(experiment.folder, "events.csv")
    assert [row["who"] for row in events if row["event"] == "consent"] == ["P1", "P2"]


def test_people_are_asked_in_plan_order(experiment: Experiment) -> None:
    """Participants are asked in the order of the plan, and rest between two blocks."""
    people = People(experiment)
    assert people.run()
    assert list(dict.fromkeys(key for _, key in people.steps)) == [
        "consent 1",
        "trial 1",
        "questionnaire 1 tlx",
        "trial 2",
        "questionnaire 2 tlx",
        "questionnaire 2 trust",
    ]
    assert {site for site, _ in people.steps} == {"m1", "m2"}
    assert_whole(experiment)
    assert people.monotonic_ns() > 30 * NS_PER_S


def test_the_last_page_shows_the_last_measures(experiment: Experiment) -> None:
    people = People(experiment)
    people.run()
    page = people.stage.describe("user", "m1", 0, None)
    assert page["phase"] == "over"
    completion_s = experiment.to_rows()[-1]["completion_s"]
    assert page["told"]["measures"] == {"completion_s": completion_s}


def test_answers_of_participants_are_averaged(experiment: Experiment) -> None:
    """Participants who answer 40 to every question have a mean of 40."""
    People(experiment, answer=40.0).run()
    means = analyse_experiment(experiment.folder).means["tlx"]
    assert {mean.mean for mean in means} == {40.0}


def kill_in(when: str, number: int) -> Any:
    """Returns a fault that ends the program in the session of a trial, or at its start."""

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
        People(experiment).run(kill_in(when, number))
    again = People(open_experiment(experiment.folder))
    assert again.run()
    assert ("m1", "consent 1") not in again.steps
    assert_whole(experiment)
    events = read_table(experiment.folder, "events.csv")
    reasons = [row["text"] for row in events if row["event"] == "aborted"]
    assert reasons == (["the program was ended"] if when == "the session" else [])


def test_trials_with_finished_logs_survive_a_kill(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(ExperimentTrial, "settle", kill)
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
    def fill_disk_in_second(watch: TrialWatch, folder: Path) -> SessionResult | None:
        if watch.trial.planned.number == 1:
            return None
        problems = ["recorder ended with code 5: No space left on device"]
        return SessionResult(folder / "run.mcap", problems, exit_code=LogRefused.exit_code)

    with pytest.raises(LogRefused, match="No space left"):
        People(experiment).run(fill_disk_in_second)
    assert len(open_experiment(experiment.folder).to_rows()) == 1
    assert People(open_experiment(experiment.folder)).run()
    assert_whole(experiment)


@pytest.mark.parametrize("step_ns", [-(10**13), 10**13])
def test_stepping_wall_clocks_change_only_note_times(
    step_ns: int, experiment: Experiment
) -> None:
    people = People(experiment)

    def step_wall_clock(watch: TrialWatch, _: Path) -> None:
        people.wall_ns = step_ns if watch.trial.planned.number == 1 else 0

    assert people.run(step_wall_clock)
    assert_whole(experiment)
    assert people.monotonic_ns() < 120 * NS_PER_S


def test_aborted_trials_are_kept_aside_and_repeated(experiment: Experiment) -> None:
    tries: list[str] = []

    def stop_first_try(watch: TrialWatch, folder: Path) -> SessionResult | None:
        tries.append(folder.name)
        if len(tries) > 1:
            return None
        watch.aborted = "m1 stopped it"
        (folder / "run.mcap").write_bytes(b"of the try that was stopped")
        return SessionResult(folder / "run.mcap")

    people = People(experiment)
    assert people.run(stop_first_try)
    assert tries == ["00001-01", "00001-02", "00002-01"]
    assert (experiment.folder / "tries" / "00001-01" / "run.mcap").exists()
    assert "trial 1 must be repeated: m1 stopped it" in people.said
    assert_whole(experiment)


def test_logs_that_end_early_do_not_count(experiment: Experiment) -> None:
    """A trial whose log ends early is kept aside and repeated."""
    tries: list[str] = []

    def break_first_log(_: TrialWatch, folder: Path) -> SessionResult | None:
        tries.append(folder.name)
        if len(tries) > 1:
            return None
        (folder / "run.mcap").write_bytes(b"no log")
        return SessionResult(folder / "run.mcap")

    assert People(experiment).run(break_first_log)
    assert (experiment.folder / "tries" / "00001-01").is_dir()
    assert_whole(experiment)


def test_people_and_models_share_no_folder(experiment: Experiment) -> None:
    people = People(experiment)
    people.run(lambda watch, _: setattr(people, "ends", watch.trial.planned.number == 1))
    with pytest.raises(
        UsageError, match="the finished trials were done by people: continue with"
    ):
        open_experiment(experiment.folder).run(jobs=1)


def test_a_trial_goes_on_after_its_first_tick(experiment: Experiment) -> None:
    trial = make_experiment_trial(experiment, experiment.plan.trials[0])
    assert TrialJudge(trial).accept(0.0, [-0.6, 1.2], [0.0, 0.0]) is None


def find_first_trial(experiment: Experiment) -> Any:
    """Returns the step of the first trial."""
    return next(step for step in experiment.plan.list_steps() if step.kind == "trial")


def test_first_page_of_a_role_speaks_for_it(experiment: Experiment, stage: Stage) -> None:
    request = stage.request_step(find_first_trial(experiment))
    stage.poll(NO_SESSION, [("m1", 7), ("m1", 9), ("m2", 8)])
    ready = DoStep(key="trial 1")
    assert not stage.accept("m1", 9, ready)
    assert not stage.accept("m1", 7, DoStep(key="trial 2"))
    assert not stage.accept("", 3, ready)
    assert stage.accept("m1", 7, ready)
    assert request.replies.keys() == {"m1"}
    assert stage.describe("user", "m1", 9, None)["second"]
    assert not stage.describe("user", "m1", 7, None)["second"]
    stage.poll(NO_SESSION, [("m1", 9), ("m2", 8)])  # who leaves is not ready any more
    assert not request.replies
    assert stage.accept("m1", 9, ready)


def test_answers_are_those_of_the_scale(experiment: Experiment, stage: Stage) -> None:
    step = next(step for step in experiment.plan.list_steps() if step.kind == "questionnaire")
    request = stage.request_step(step)
    stage.poll(NO_SESSION, [("m1", 1), ("m2", 2)])
    for answers in ([], [40.0] * 5, [41.0] * 6, [105.0] * 6, [-5.0] * 6):
        assert not stage.accept("m1", 1, DoStep(key=step.key, answers=answers))
    assert stage.accept(
        "m1", 1, DoStep(key=step.key, answers=[0.0, 100.0, 5.0, 50.0, 60.0, 95.0])
    )
    assert request.replies["m1"][0]["physical"] == 100.0
    assert stage.accept(
        "m2", 2, DoStep(key=step.key, answers=[0.0, None, 5.0, None, 60.0, 95.0])
    )
    assert request.replies["m2"][0]["physical"] is None  # a slider that nobody touched


def test_users_are_not_told_the_condition(experiment: Experiment, stage: Stage) -> None:
    stage.request_step(find_first_trial(experiment))
    stage.poll(NO_SESSION, [("m1", 1)])
    user_page = stage.describe("user", "m1", 1, None)
    experimenter_page = stage.describe("experimenter", "", 1, None)
    assert "near" not in str(user_page)
    assert experimenter_page["condition"] == "near"
    assert [user["state"] for user in user_page["users"]] == ["here", ""]


@pytest.fixture
def watched(experiment: Experiment, tmp_path: Path) -> tuple[Any, Any, Any]:
    """A trial, its entry by its log, and the records of its slave."""
    plan = experiment.plan
    trial = SyntheticTrial(plan.protocol, plan.scenarios["near"], plan.trials[0], plan.digest)
    entry = trial.write(tmp_path / "log.mcap")
    return trial, entry, open_log(tmp_path / "log.mcap")


def make_view(trial: ExperimentTrial, log: Any, last: int, mode: str = "run") -> Any:
    """Returns a view of a session whose slave has made the ticks of a log up to `last`."""
    window = RecordWindow(trial.scenario, "s", kept_s=60.0)
    for record in log["s"].states[: last + 1]:
        window.receive(record)
    site = SimpleNamespace(window=window, complete=last, record=SimpleNamespace(mode=mode))
    return SimpleNamespace(running=True, sites={"s": site})


def test_users_see_own_target_and_corridor(tmp_path: Path, clock: ManualClock) -> None:
    """Each user sees a target of its own, and a corridor only if the task has one."""

    def describe_first_trial(task: str, site: str) -> Any:
        folder = tmp_path / task[-3:] / (site or "-")
        folder.mkdir(parents=True)
        experiment = Experiment.begin(write_protocol(folder, PAIR, task), folder / "out")
        trial = make_experiment_trial(experiment, experiment.plan.trials[0])
        return TrialWatch(trial, clock).describe(trial.appears_s + 0.5, site)

    first_m = describe_first_trial(APART, "m1")["target"]["at"]
    second_m = describe_first_trial(APART, "m2")["target"]["at"]
    middle_m = describe_first_trial(APART, "")["target"]["at"]
    assert first_m[0] - second_m[0] == pytest.approx(0.1)
    assert middle_m[0] == pytest.approx(0.5 * (first_m[0] + second_m[0]))

    with_corridor = describe_first_trial(f"{REACH}\ncorridor_m = 0.03", "m1")
    assert with_corridor["way"]["width_m"] == 0.03
    assert with_corridor["way"]["from"] != with_corridor["target"]["at"]
    assert "way" not in describe_first_trial(REACH, "m1")


def test_watch_judges_as_the_log_does(watched: Any, clock: ManualClock) -> None:
    """A watch of the records during a trial has the outcome of the finished log."""
    trial, entry, log = watched
    watch = TrialWatch(trial, clock)
    moments = []
    for last in range(3, len(log["s"]), 17):
        moments += watch.poll(make_view(trial, log, last), ())
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
    assert watch.poll(make_view(trial, log, 5, "stopped"), ()) == ["trial 1 aborted: s stopped"]
    assert watch.over


def test_an_absent_page_ends_the_trial(
    experiment: Experiment, stage: Stage, watched: Any
) -> None:
    trial, _, log = watched
    clock = stage._clock
    stage.request_step(find_first_trial(experiment))
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
        stage.poll(make_view(trial, log, 5), pages)
        assert not watch.aborted  # a page that was reloaded is back in time
    clock.sleep_until(clock.monotonic_ns() + MAX_ABSENCE_NS + 1)
    stage.poll(make_view(trial, log, 5), both[:1])
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
    clock = SystemClock()
    network = LocalNetwork()
    stage = Stage(experiment.plan, clock)
    request = stage.request_step(find_first_trial(experiment))
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
        until(lambda: "m1" in request.replies)
        server.show(network.join(), "another")
        assert server.view.session == "another"
        until(lambda: user.take() == {} and user.hello["session"] == "another")
