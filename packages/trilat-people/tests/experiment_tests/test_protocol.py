"""Protocols of experiments: orders that balance, a digest, and everything that is wrong at once."""

from collections import Counter, defaultdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest
from trilat_people.experiment.protocol import ExperimentPlan, ExperimentProtocol
from trilat_people.experiment.questionnaires import Questionnaire
from trilat_people.experiment.trial_run import ExperimentTrial

import trilat_net as tn
from trilat_net.scenario import load_scenario

LIVE = {"sites.m1.hands": [{"kind": "live"}], "sites.m2.hands": [{"kind": "live"}]}


def make_protocol(**keys: Any) -> ExperimentProtocol:
    """Returns the protocol of four participants and two conditions, with some keys replaced."""
    protocol = {
        "name": "study",
        "scenario": "paper",
        "set": LIVE,
        "conditions": {"near": {"link.delay_ms": 0}, "far": {"link.delay_ms": 300}},
        "participants": 4,
    }
    return msgspec.convert({**protocol, **keys}, ExperimentProtocol)


def test_keys_of_a_site_leave_its_others() -> None:
    """Written as TOML nests them: role, arm and what another table sets stay."""
    nested = {"sites": {"m1": {"hands": [{"kind": "live"}]}, "s": {"q0_rad": [-0.6, 1.2]}}}
    conditions = {
        "near": {"dominance": {"s": {"m1": 0.8, "m2": 0.2}}},
        "far": {"sites": {"s": {"qd0_rad_s": 0.1}}},
    }
    plan = ExperimentPlan.of_protocol(make_protocol(set=nested, conditions=conditions))
    paper = load_scenario("paper")
    for scenario in plan.scenarios.values():
        assert [site.role for site in scenario.sites.values()] == ["master", "master", "slave"]
        assert scenario.sites["s"].q0_rad == (-0.6, 1.2)
        assert scenario.sites["m2"] == paper.sites["m2"]
        assert scenario.dominance["m1"] == paper.dominance["m1"]
    assert plan.scenarios["near"].dominance["s"] == {"m1": 0.8, "m2": 0.2}
    assert plan.scenarios["far"].dominance == paper.dominance
    assert plan.scenarios["far"].sites["s"].qd0_rad_s == (0.1, 0.1)


def list_orders(design: str, names: list[str], seed: int = 1) -> list[tuple[str, ...]]:
    """Returns the orders of conditions of these names."""
    conditions = {name: {"link.delay_ms": n} for n, name in enumerate(names)}
    return make_protocol(design=design, conditions=conditions, seed=seed).list_orders()


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7])
def test_williams_balances_places_and_neighbours(count: int) -> None:
    """Williams, Aust. J. Sci. Res. A 2, 1949: equally often at each place, and after each other one."""
    names = [f"c{n}" for n in range(count)]
    orders = list_orders("williams", names, 1)
    assert len(orders) == count * (1 + count % 2)
    places = Counter((place, name) for order in orders for place, name in enumerate(order))
    after = Counter(pair for order in orders for pair in pairwise(order))
    assert set(places.values()) == {len(orders) // count}
    assert set(after.values()) == {len(orders) // count}
    assert len(after) == count * (count - 1)


def test_latin_square_balances_places() -> None:
    orders = list_orders("latin", ["a", "b", "c"], 1)
    assert all(sorted(column) == ["a", "b", "c"] for column in zip(*orders, strict=True))


def test_random_orders_are_a_function_of_the_seed() -> None:
    names = ["a", "b", "c", "d"]
    assert list_orders("random", names, 3) == list_orders("random", names, 3)
    assert list_orders("random", names, 3) != list_orders("random", names, 4)
    assert list_orders("fixed", names, 3) == [tuple(names)]


def test_every_trial_has_its_place_and_seed() -> None:
    plan = ExperimentPlan.of_protocol(make_protocol(practice=1, trials=3))
    assert len(plan.trials) == 4 * 2 * 4
    assert [planned.number for planned in plan.trials] == list(range(1, 33))
    assert len({planned.seed for planned in plan.trials}) == 32
    assert len({planned.file for planned in plan.trials}) == 32
    assert sum(planned.practice for planned in plan.trials) == 8
    assert [planned.before for planned in plan.trials[:8]] == list(range(8))
    assert plan.list_orders()["P1"] == ["near", "far"]
    assert plan.list_orders()["P2"] == ["far", "near"]


def test_targets_of_a_block_follow_one_another() -> None:
    """The targets of a block are consecutive, from a first target that is drawn for each block."""
    plan = ExperimentPlan.of_protocol(make_protocol(practice=1, trials=3))
    first_targets = set()
    for first in range(0, 32, 4):
        targets = [planned.target for planned in plan.trials[first : first + 4]]
        assert targets == list(range(targets[0], targets[0] + 4))
        first_targets.add(targets[0])
    assert len(first_targets) > 4


def test_pairs_hold_two_masters() -> None:
    plan = ExperimentPlan.of_protocol(make_protocol(users=["m1", "m2"]))
    groups = list(dict.fromkeys(planned.group for planned in plan.trials))
    assert groups == [("P1", "P2"), ("P3", "P4")]


def test_the_digest_covers_the_plan() -> None:
    first = ExperimentPlan.of_protocol(make_protocol()).digest
    assert ExperimentPlan.of_protocol(make_protocol()).digest == first
    assert ExperimentPlan.of_protocol(make_protocol(seed=2)).digest != first
    assert (
        ExperimentPlan.of_protocol(make_protocol(set={**LIVE, "rate_hz": 500})).digest != first
    )


def test_template_is_a_protocol(tmp_path: Path) -> None:
    plan = tn.check_experiment(tn.new_experiment(tmp_path / "reaching.toml"))
    assert "12 participants at m1, reaching to a ring of targets" in plan.summary()
    assert plan.to_dict()["counted"] == 12 * 4 * 4


def test_catch_trials_share_every_other_block() -> None:
    plan = ExperimentPlan.of_protocol(
        make_protocol(trials=10, practice=2, catch={"condition": "near", "share": 0.2})
    )
    blocks = defaultdict(list)
    for planned in plan.trials:
        blocks[planned.group, planned.block].append(planned)
    for block in blocks.values():
        condition = next(planned.condition for planned in block if not planned.catch)
        catch_trials = [planned for planned in block if planned.catch]
        assert len(catch_trials) == (0 if condition == "near" else 2)
        for planned in catch_trials:
            assert planned.condition == "near"
            assert not planned.practice
    places = {planned.trial for planned in plan.trials if planned.catch}
    assert len(places) > 2  # drawn for every block
    assert plan.list_orders()["P1"] == ["near", "far"]
    assert plan.to_dict()["counted"] == 4 * (10 + 8)


def test_participant_who_bears_less_has_a_weaker_hand() -> None:
    protocol = make_protocol(force_limit_n={"P2": 7.0})
    plan = ExperimentPlan.of_protocol(protocol)
    for planned in plan.trials:
        trial = ExperimentTrial(
            protocol, plan.scenarios[planned.condition], planned, plan.digest
        )
        assert trial.scenario.sites["m1"].hands[0].force_limit_n == (
            7.0 if planned.group == ("P2",) else 40.0
        )


def test_people_are_asked_around_their_trials() -> None:
    """A participant consents first, answers after each block, and answers once more at the end."""
    forms = [{"name": "tlx"}, {"name": "sus", "after": "experiment"}]
    plan = ExperimentPlan.of_protocol(
        make_protocol(trials=1, consent="Yes?", questionnaires=forms)
    )
    keys = [step.key for step in plan.list_steps() if step.planned.group == ("P1",)]
    assert keys == [
        "consent 1",
        "trial 1",
        "questionnaire 1 tlx",
        "trial 2",
        "questionnaire 2 tlx",
        "questionnaire 2 sus",
    ]
    assert len(list(plan.list_steps())) == 4 * len(keys)


def test_shipped_questionnaires_have_their_published_scores() -> None:
    forms = {name: Questionnaire(name=name).find_form() for name in ("tlx", "sus", "agency")}
    assert {name: len(form.items) for name, form in forms.items()} == {
        "tlx": 6,
        "sus": 10,
        "agency": 4,
    }
    assert forms["tlx"].score(forms["tlx"].read([10.0, 20.0, 30.0, 40.0, 50.0, 60.0])) == 35.0
    assert forms["sus"].score(forms["sus"].read([5.0, 1.0] * 5)) == 100.0
    assert forms["agency"].score(forms["agency"].read([3.0, -3.0, 1.0, 1.0])) == 0.5
