"""What participants are asked for, against the logs of the trials in which synthetic ones did it."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trilat_people.experiment.experiment_run import Experiment, begin_experiment
from trilat_people.experiment.protocol import PlannedTrial
from trilat_people.experiment.tasks import ContactTrial, ReachTrial, TrackTrial
from trilat_people.experiment.trial_run import ExperimentTrial, TrialJudge

import trilat_net as tn
from tests.experiments import APART, CONTACT, HANDOVER, REACH, TRACK, write_protocol
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.core.step.vectors import Array
from trilat_net.log.log_reader import Log

PAIR = '["m1", "m2"]'
TRAINING = """
[training]
lead = { near = [0.9, 0.1], far = [0.5, 0.5] }
before = 1
after = 2
retention = 1
rest_s = 90
"""


def run(folder: Path, *how: Any) -> tuple[Experiment, list[dict[str, Any]]]:
    done = tn.run_experiment(write_protocol(folder, *how), folder / "out", jobs=1)
    return done, done.to_rows()


def open_logs(done: Experiment) -> list[Log]:
    return [tn.open_log(done.folder / row["log"]) for row in done.to_rows()]


def place_rows(log: Log) -> Array:
    return np.array([log.scenario.arms["s"].end_effector(q) for q in log["s"].q])


def find_appearance_s(done: Experiment, planned: PlannedTrial) -> float:
    plan = done.plan
    return ExperimentTrial(
        plan.protocol, plan.scenarios[planned.condition], planned, plan.digest
    ).appears_s


def find_end_s(done: Experiment, row: dict[str, Any]) -> float:
    return (
        find_appearance_s(done, done.plan.trials[row["trial_number"] - 1])
        + row["completion_s"]
        + 1e-9
    )


def test_wall_force_is_held_for_the_dwell(tmp_path: Path) -> None:
    """By the depth in the wall, 1000 N/m, of the slave: not by the torques that the judge looks at."""
    done, rows = run(tmp_path, '["m1"]', CONTACT)
    for row, log in zip(rows, open_logs(done), strict=True):
        ended_s = find_end_s(done, row)
        held = (log["s"].t_s <= ended_s) & (log["s"].t_s > ended_s - 1.0)
        force_n = 1000.0 * (place_rows(log)[held, 0] - 1.69)
        assert row["succeeded"]
        assert np.abs(force_n - 4.0).max() < 1.05
        assert row["wall_force_n"] == pytest.approx(force_n.mean(), abs=0.05)
        assert row["work_j"] > 0.0


def test_leaving_the_corridor_fails_at_once(tmp_path: Path) -> None:
    done, rows = run(tmp_path, PAIR, f"{REACH}\ncorridor_m = 0.012")
    assert any(not row["succeeded"] for row in rows)
    for row, log in zip(rows, open_logs(done), strict=True):
        start, target = (
            np.array([row[f"{name}_x_m"], row[f"{name}_y_m"]]) for name in ("start", "target")
        )
        way, ended_s = (target - start) / np.linalg.norm(target - start), find_end_s(done, row)
        off = place_rows(log)[log["s"].t_s <= ended_s] - start
        along = np.clip(off @ way, 0.0, np.linalg.norm(target - start))
        aside_m = np.linalg.norm(off - along[:, None] * way, axis=1)
        assert (aside_m.max() > 0.006) == (not row["succeeded"])
        assert aside_m[:-1].max() <= 0.006


def test_after_a_handover_the_second_user_alone_leads(tmp_path: Path) -> None:
    done, rows = run(tmp_path, PAIR, HANDOVER)
    for planned, row, log in zip(done.plan.trials, rows, open_logs(done), strict=True):
        (change,), appears_s = log.scenario.timeline, find_appearance_s(done, planned)
        assert (change.at_s, change.ramp_s) == (appears_s + 3.0, 1.0)
        assert (log.scenario.dominance["s"], change.to) == (
            {"m1": 1.0, "m2": 0.0},
            {"m1": 0.0, "m2": 1.0},
        )
        last = np.concatenate([log["m2"].q[-1:], log["s"].q_des[-1:]])
        assert np.linalg.norm(last[0] - last[1]) < 0.2  # what the slave follows in the end
        assert row["completion_s"] > 4.0
        targets = ReachTrial(targets=4, distance_m=0.1)
        first = targets.make_goal(
            place_rows(log)[0], planned.target, planned.seed
        ).find_target_m(1.0)
        ramp = (log["s"].t_s >= appears_s + 3.0) & (log["s"].t_s < appears_s + 4.0)
        most_m = np.linalg.norm(place_rows(log)[ramp] - first, axis=1).max()
        assert row["error_handover_mm"] == pytest.approx(1e3 * most_m, abs=1.0)


def test_users_shown_two_targets_settle_by_their_shares(tmp_path: Path) -> None:
    """The slave is nearer to what the user with the larger share is shown."""
    found = {}
    for first in (0.2, 0.8):
        (folder := tmp_path / str(first)).mkdir()
        _, rows = run(folder, PAIR, APART, "", first)
        found[first] = np.mean([row["first_settled"] for row in rows])
    assert found[0.2] < 0.5 < found[0.8]
    goal = TrackTrial(apart_m=0.1).make_goal(np.zeros(2), 0, 1)
    apart = goal.find_target_m(1.0, 0) - goal.find_target_m(1.0, 1)
    assert apart.tolist() == pytest.approx([0.1, 0.0])
    assert goal.find_target_m(1.0).tolist() == pytest.approx(
        (goal.find_target_m(1.0, 1) + 0.5 * apart).tolist()
    )


def test_authority_moves_from_the_expert_trial_by_trial(tmp_path: Path) -> None:
    """The learner alone before, after and later; the expert's part falls in between."""
    begun = begin_experiment(write_protocol(tmp_path, PAIR, TRACK, TRAINING), tmp_path / "out")
    plan = begun.plan
    block = [one for one in plan.trials if one.block == 1]
    assert [(one.phase, one.lead) for one in block] == [
        ("before", 0.0),
        ("training", 0.9),
        ("training", 0.1),
        ("after", 0.0),
        ("after", 0.0),
        ("retention", 0.0),
    ]
    assert [plan.rest_before_s(one) for one in block] == [0.0] * 5 + [90.0]
    for one in block:
        trial = ExperimentTrial(plan.protocol, plan.scenarios[one.condition], one, plan.digest)
        row = trial.scenario.dominance["s"]
        assert (row["m1"], row["m2"]) == pytest.approx((one.lead, 1.0 - (one.lead or 0.0)))
        assert trial.make_goal().has_authority(5.0, 1)
        assert trial.make_goal().has_authority(5.0, 0) == (one.phase == "training")


def test_learning_is_before_less_after(tmp_path: Path) -> None:
    done, rows = run(tmp_path, PAIR, TRACK, TRAINING)
    found = tn.analyse_experiment(done.folder)
    phases = defaultdict(list)
    for row in rows:
        phases[row["condition"], row["phase"]].append(row["error_rms_mm"])
    for gain in found.gain_rows:
        before, after, later = (
            np.mean(phases[gain["condition"], phase])
            for phase in ("before", "after", "retention")
        )
        assert gain["gain_after_error_rms_mm"] == pytest.approx(before - after)
        assert gain["gain_retention_error_rms_mm"] == pytest.approx(before - later)
    assert len(found.gain_rows) == 2
    assert {row["phase"] for row in found.rows} == {"after"}
    assert found.means["gain_after_error_rms_mm"][0].number == 1
    assert (
        "the expert's part of the authority went from 0.9 to 0.1 (near), 0.5 to 0.5 (far)"
        in found.study["training"]
    )


def test_a_force_counts_only_while_it_is_held() -> None:
    goal = ContactTrial(force_n=5.0, tolerance_n=1.0, dwell_s=0.5, timeout_s=2.0).make_goal(
        np.zeros(2), 0, 1
    )
    at = np.zeros(2)
    assert goal.judge(0.0, at, 5.9) is None
    assert goal.judge(0.4, at, 6.1) is None
    assert goal.judge(0.6, at, 4.1) is None
    outcome = goal.judge(1.1, at, 5.0)
    assert outcome is not None
    assert outcome == (True, 1.1)
    goal = ContactTrial(timeout_s=2.0).make_goal(np.zeros(2), 0, 1)
    assert goal.judge(2.0, at, 0.0) == (False, 2.0)


def test_slave_force_equals_the_walls(tmp_path: Path) -> None:
    plan = tn.check_experiment(write_protocol(tmp_path, '["m1"]', CONTACT))
    scenario = plan.scenarios["near"]
    q, force = np.array([[0.3, 0.9]]), np.array([3.0, -4.0])
    tau_x = -build_arm_rows(scenario, "s").place_end_effector(q, 0.0 * q).J[0].T @ force
    judge = TrialJudge(ExperimentTrial(plan.protocol, scenario, plan.trials[0], plan.digest))
    judge.goal.appears_s, judge.goal.force_n = 0.0, 5.0
    assert all(
        judge.accept(t_s, q[0].tolist(), tau_x.tolist()) is None
        for t_s in np.linspace(0.0, 0.9, 10)
    )
    outcome = judge.accept(1.0, q[0].tolist(), tau_x.tolist())
    assert outcome is not None
    assert outcome.succeeded
