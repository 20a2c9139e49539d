"""What participants are asked for, against the logs of the trials in which synthetic ones did it."""

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from people_builders import PAIR, make_experiment_trial, run_protocol
from trilat_people.experiment.experiment_run import Experiment
from trilat_people.experiment.protocol import PlannedTrial
from trilat_people.experiment.tasks import ContactTrial, ReachTrial, TrackTrial
from trilat_people.experiment.trial_run import ExperimentTrial, TrialJudge

import trilat_net as tn
from tests.experiments import APART, CONTACT, HANDOVER, REACH, TRACK, write_protocol
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.core.step.vectors import Array
from trilat_net.log.log_reader import Log

TRAINING = """
[training]
lead = { near = [0.9, 0.1], far = [0.5, 0.5] }
before = 1
after = 2
retention = 1
rest_s = 90
"""


def iterate_trials(
    experiment: Experiment,
) -> Iterator[tuple[PlannedTrial, dict[str, Any], Log]]:
    """Yields the plan, the row and the log of each trial."""
    for row in experiment.to_rows():
        planned = experiment.plan.trials[row["trial_number"] - 1]
        yield planned, row, tn.open_log(experiment.folder / row["log"])


def place_slave_m(log: Log) -> Array:
    """Returns the places of the slave's end effector, in m."""
    return np.array([log.scenario.arms["s"].end_effector(q) for q in log["s"].q])


def find_appearance_s(experiment: Experiment, planned: PlannedTrial) -> float:
    """Returns the time at which the target of a trial appears."""
    return make_experiment_trial(experiment, planned).appears_s


def find_end_s(experiment: Experiment, planned: PlannedTrial, row: dict[str, Any]) -> float:
    """Returns the time at which a trial ended, after its last tick."""
    return find_appearance_s(experiment, planned) + row["completion_s"] + 1e-9


def test_wall_force_is_held_for_the_dwell(tmp_path: Path) -> None:
    """The force follows from the slave's depth in the wall of 1000 N/m, not from the torques."""
    experiment = run_protocol(write_protocol(tmp_path, '["m1"]', CONTACT))
    for planned, row, log in iterate_trials(experiment):
        ended_s = find_end_s(experiment, planned, row)
        held = (log["s"].t_s <= ended_s) & (log["s"].t_s > ended_s - 1.0)
        force_n = 1000.0 * (place_slave_m(log)[held, 0] - 1.69)
        assert row["succeeded"]
        assert np.abs(force_n - 4.0).max() < 1.05
        assert row["wall_force_n"] == pytest.approx(force_n.mean(), abs=0.05)
        assert row["work_j"] > 0.0


def test_leaving_the_corridor_fails_at_once(tmp_path: Path) -> None:
    """A trial fails in the tick in which the slave is half of the width beside the straight path."""
    file = write_protocol(tmp_path, PAIR, f"{REACH}\ncorridor_m = 0.012")
    experiment = run_protocol(file)
    assert any(not row["succeeded"] for row in experiment.to_rows())
    for planned, row, log in iterate_trials(experiment):
        start_m = np.array([row["start_x_m"], row["start_y_m"]])
        target_m = np.array([row["target_x_m"], row["target_y_m"]])
        length_m = np.linalg.norm(target_m - start_m)
        direction = (target_m - start_m) / length_m

        ended_s = find_end_s(experiment, planned, row)
        moved_m = place_slave_m(log)[log["s"].t_s <= ended_s] - start_m
        along_m = np.clip(moved_m @ direction, 0.0, length_m)
        aside_m = np.linalg.norm(moved_m - along_m[:, None] * direction, axis=1)
        assert (aside_m.max() > 0.006) == (not row["succeeded"])
        assert aside_m[:-1].max() <= 0.006


def test_after_a_handover_the_second_user_alone_leads(tmp_path: Path) -> None:
    """Three seconds after the target the shares change within 1 s, and the error is that of the change."""
    experiment = run_protocol(write_protocol(tmp_path, PAIR, HANDOVER))
    for planned, row, log in iterate_trials(experiment):
        appears_s = find_appearance_s(experiment, planned)
        (change,) = log.scenario.timeline
        assert change.at_s == appears_s + 3.0
        assert change.ramp_s == 1.0
        assert log.scenario.dominance["s"] == {"m1": 1.0, "m2": 0.0}
        assert change.to == {"m1": 0.0, "m2": 1.0}
        assert np.linalg.norm(log["m2"].q[-1] - log["s"].q_des[-1]) < 0.2
        assert row["completion_s"] > 4.0

        places_m = place_slave_m(log)
        task = ReachTrial(targets=4, distance_m=0.1)
        goal = task.make_goal(places_m[0], planned.target, planned.seed)
        ramp = (log["s"].t_s >= appears_s + 3.0) & (log["s"].t_s < appears_s + 4.0)
        error_m = np.linalg.norm(places_m[ramp] - goal.find_target_m(1.0), axis=1).max()
        assert row["error_handover_mm"] == pytest.approx(1e3 * error_m, abs=1.0)


def test_users_shown_two_targets_settle_by_their_shares(tmp_path: Path) -> None:
    """The slave is nearer to the target of the user with the larger share."""
    settled = {}
    for first_share in (0.2, 0.8):
        folder = tmp_path / str(first_share)
        folder.mkdir()
        experiment = run_protocol(write_protocol(folder, PAIR, APART, first=first_share))
        settled[first_share] = np.mean([row["first_settled"] for row in experiment.to_rows()])
    assert settled[0.2] < 0.5 < settled[0.8]


def test_two_targets_lie_around_their_middle() -> None:
    """The users' targets are as far apart as the task says, and the slave's target is between."""
    goal = TrackTrial(apart_m=0.1).make_goal(np.zeros(2), 0, 1)
    first_m = goal.find_target_m(1.0, 0)
    second_m = goal.find_target_m(1.0, 1)
    assert first_m - second_m == pytest.approx([0.1, 0.0])
    assert goal.find_target_m(1.0) == pytest.approx(0.5 * (first_m + second_m))


def test_authority_moves_from_the_expert_trial_by_trial(tmp_path: Path) -> None:
    """The learner alone before, after and later; the expert's part falls in between."""
    file = write_protocol(tmp_path, PAIR, TRACK, TRAINING)
    experiment = Experiment.begin(file, tmp_path / "out")
    plan = experiment.plan
    block = [planned for planned in plan.trials if planned.block == 1]
    assert [(planned.phase, planned.lead) for planned in block] == [
        ("before", 0.0),
        ("training", 0.9),
        ("training", 0.1),
        ("after", 0.0),
        ("after", 0.0),
        ("retention", 0.0),
    ]
    assert [plan.rest_before_s(planned) for planned in block] == [0.0] * 5 + [90.0]
    for planned in block:
        trial = make_experiment_trial(experiment, planned)
        lead = planned.lead or 0.0
        assert trial.scenario.dominance["s"] == pytest.approx({"m1": lead, "m2": 1.0 - lead})
        assert trial.make_goal().has_authority(5.0, 1)
        assert trial.make_goal().has_authority(5.0, 0) == (planned.phase == "training")


def test_learning_is_before_less_after(tmp_path: Path) -> None:
    """The gain of a phase is the mean error before the training less that of the phase."""
    experiment = run_protocol(write_protocol(tmp_path, PAIR, TRACK, TRAINING))
    analysis = tn.analyse_experiment(experiment.folder)
    errors_mm = defaultdict(list)
    for row in experiment.to_rows():
        errors_mm[row["condition"], row["phase"]].append(row["error_rms_mm"])
    assert len(analysis.gain_rows) == 2
    for gain in analysis.gain_rows:
        before_mm = np.mean(errors_mm[gain["condition"], "before"])
        for phase in ("after", "retention"):
            gain_mm = before_mm - np.mean(errors_mm[gain["condition"], phase])
            assert gain[f"gain_{phase}_error_rms_mm"] == pytest.approx(gain_mm)
    assert {row["phase"] for row in analysis.rows} == {"after"}
    assert analysis.means["gain_after_error_rms_mm"][0].number == 1
    assert (
        "the expert's share of the authority changed from 0.9 to 0.1 (near), 0.5 to 0.5 (far)"
        in analysis.study["training"]
    )


def test_a_force_counts_only_while_it_is_held() -> None:
    """A force outside of the tolerance begins the dwell time anew."""
    task = ContactTrial(force_n=5.0, tolerance_n=1.0, dwell_s=0.5, timeout_s=2.0)
    place_m = np.zeros(2)
    goal = task.make_goal(place_m, 0, 1)
    assert goal.judge(0.0, place_m, 5.9) is None
    assert goal.judge(0.4, place_m, 6.1) is None
    assert goal.judge(0.6, place_m, 4.1) is None
    assert goal.judge(1.1, place_m, 5.0) == (True, 1.1)


def test_a_contact_fails_at_its_time_limit() -> None:
    goal = ContactTrial(timeout_s=2.0).make_goal(np.zeros(2), 0, 1)
    assert goal.judge(2.0, np.zeros(2), 0.0) == (False, 2.0)


def test_slave_force_equals_the_walls(tmp_path: Path) -> None:
    plan = tn.check_experiment(write_protocol(tmp_path, '["m1"]', CONTACT))
    scenario = plan.scenarios["near"]
    q = np.array([[0.3, 0.9]])
    force_n = np.array([3.0, -4.0])
    jacobian = build_arm_rows(scenario, "s").place_end_effector(q, 0.0 * q).J[0]
    tau_x = -jacobian.T @ force_n
    judge = TrialJudge(ExperimentTrial(plan.protocol, scenario, plan.trials[0], plan.digest))
    judge.goal.appears_s = 0.0
    judge.goal.force_n = 5.0
    for t_s in np.linspace(0.0, 0.9, 10):
        assert judge.accept(t_s, q[0].tolist(), tau_x.tolist()) is None
    outcome = judge.accept(1.0, q[0].tolist(), tau_x.tolist())
    assert outcome is not None
    assert outcome.succeeded
