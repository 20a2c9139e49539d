"""Each premise, in runs that satisfy it and in runs that violate it.

Walls that are held over a tick: their energy, the damping that dissipates this energy, and the
premise by its name.
"""

import ast
import inspect
from collections.abc import Iterator, Mapping
from types import ModuleType, SimpleNamespace
from typing import get_args, get_type_hints

import numpy as np
import pytest

import trilat_net
from tests.analysis.builders import EXPERT, make_run
from tests.scenario.builders import make_overrides, rough_arm_text
from trilat_net.analysis import run_end, run_remarks, stability_decision
from trilat_net.analysis.certificate import (
    energy_balance,
    functional_judgements,
    observed_energy,
    premise_quantities,
    stability_certificate,
    verdict_facts,
)
from trilat_net.analysis.certificate import premises as premises_module
from trilat_net.analysis.certificate.premise_quantities import (
    AbsentSpan,
    Premise,
    PremiseQuantities,
)
from trilat_net.analysis.certificate.premises import RunFacts
from trilat_net.analysis.torque_sources import WallEnergy
from trilat_net.analysis.twins import envelope_trend
from trilat_net.core.step.vectors import Array
from trilat_net.log.log_reader import Log
from trilat_net.presentation import decision_text, end_text, verdict_text
from trilat_net.presentation.verdict_text import REQUIREMENTS
from trilat_net.scenario import load_scenario, parse_scenario

SHORT = {"duration_s": 1.5, "rate_hz": 200, "link.delay_ms": 100.0}
CUT = {"links.m2->s.outages_s": [[0.45, 1.0]], "links.m2->s.delay_ms": 100.0}
LATE = {"links.m1->s.outages_s": [[0.0, 0.5]], "links.m1->s.delay_ms": 100.0}


def check_shipped(name: str = "free", **overrides: object) -> dict[str, Premise]:
    """Returns the premises of a shipped scenario, by name."""
    run = make_run(name, {**SHORT, **make_overrides(**overrides)})
    return {premise.name: premise for premise in run.certificate.premises}


def test_free_motion_satisfies_all_premises() -> None:
    checked = check_shipped()
    assert [p.name for p in checked.values() if p.holds is not True] == []
    assert checked["delays"].text == "constant on every link: 100 ms"
    assert checked["hands"].text == "no operator or wall pushes"


@pytest.mark.parametrize(
    ("name", "overrides", "says"),
    [
        (
            "law",
            {"sites__m2__control__law": "p_d"},
            "m2: law p_d has no functional V",
        ),
        (
            "parameters",
            {"control__Gamma": [1.0, 1.0, 1.0, 0.0, 0.0]},
            "neither learnt nor known",
        ),
        (
            "parameters",
            {"control__law": "adaptive_box", "control__theta_high": 1.9},
            "theta is outside the box",
        ),
        (
            "Kd",
            {"sites__s__control__Kd": [1.0, 3.0]},
            "no beta exists: m1 (3, 3), m2 (3, 3), s (1, 3)",
        ),
        ("Kd", {"control__Kd": 0.0}, "some Kd is zero"),
        ("shares", EXPERT, "none of m1, s follows m2, whose beta is 0"),
        (
            "delays",
            {"link__model": "uniform", "link__half_width_ms": 30.0},
            "the age of the sample in",
        ),
        ("delays", {"sites__m1__rate_hz": 100}, "varies"),
        (
            "delays",
            LATE,
            "m1->s",
        ),  # ages before a first sample do not count, but it must not be late
        (
            "following",
            {"on_stale__action": "hold", "on_stale__age_ms": 150.0, **CUT},
            "brake or return: s 0.6 to 1.",
        ),
        (
            "following",
            {
                "on_stale__action": "hold",
                "on_stale__age_ms": 150.0,
                "on_stale__return_s": 0.1,
                **CUT,
                "links.m2->s.outages_s": [[0.3, 0.5], [0.9, 1.1]],
            },
            "brake or return: s 0.45 to 0.7 s, s 1.05 to 1.3 s",
        ),
        ("torque", {"limits__tau_limit_nm": 10.0}, "cut off: m1 at "),
    ],
)
def test_a_failed_premise_gives_its_reason(
    name: str, overrides: dict[str, object], says: str
) -> None:
    failed = check_shipped(**overrides)[name]
    assert failed.holds is False
    assert says in failed.text
    assert [text for text in strings_in(failed.quantities) if " " in text] == []


def strings_in(value: object) -> Iterator[str]:
    """Yields every string in the quantities of a premise."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        yield from strings_in((*value.keys(), *value.values()))
    elif isinstance(value, tuple):
        for item in value:
            yield from strings_in(item)


def test_each_kind_of_quantities_has_its_sentence() -> None:
    assert set(verdict_text.PREMISE_DESCRIBERS) == set(get_args(PremiseQuantities))


def list_premise_names() -> set[str]:
    """Returns the names of all premises of the theorem that the source creates."""
    tree = ast.parse(inspect.getsource(premises_module))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    created = [call for call in calls if getattr(call.func, "id", "") == "Premise"]
    return {call.args[0].value for call in created if isinstance(call.args[0], ast.Constant)}


def test_each_premise_that_fails_is_explained() -> None:
    """A name alone says nothing to a newcomer; missing records leave a premise undecided."""
    assert list_premise_names() - {"records"} == set(REQUIREMENTS)


def list_clauses(module: ModuleType) -> set[str]:
    """Returns the strings of three or more words in a module that are no docstrings."""
    tree = ast.parse(inspect.getsource(module))
    skipped = set()
    for node in ast.walk(tree):
        is_hook = isinstance(node, ast.Call) and getattr(node.func, "id", "") == "find_hook"
        if is_hook or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
            skipped.update(id(child) for child in ast.walk(node))
        if isinstance(node, ast.FunctionDef) and isinstance(node.returns, ast.Constant):
            skipped.add(id(node.returns))  # an annotation in quotes
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in skipped
        and len(node.value.split()) > 2
    }


@pytest.mark.parametrize(
    "module",
    [
        envelope_trend,
        functional_judgements,
        observed_energy,
        premise_quantities,
        premises_module,
        run_end,
        run_remarks,
        stability_certificate,
        stability_decision,
        verdict_facts,
    ],
    ids=lambda module: module.__name__.rpartition(".")[2],
)
def test_judging_modules_have_no_sentence(module: ModuleType) -> None:
    """The analysis finds names and numbers, of which the presentation makes sentences."""
    phrases = {behaviour.value for behaviour in run_end.EndBehaviour}
    assert list_clauses(module) - phrases == set()


def test_sentences_are_recognised() -> None:
    """The name of a source of energy is a key of the JSON output."""
    assert len(list_clauses(verdict_text)) > 20
    assert list_clauses(energy_balance) == {"what beta does not cancel"}


def test_each_kind_of_facts_has_its_sentence() -> None:
    assert set(verdict_text.FACT_DESCRIBERS) == set(get_args(verdict_facts.VerdictFacts))
    assert set(verdict_text.RECORD_GAPS) == set(verdict_facts.RecordGap)


def test_each_name_of_a_decision_has_its_sentence() -> None:
    """Of a short record the decision itself states the length that would suffice."""
    assert set(decision_text.BASES) == set(get_args(stability_decision.Basis))
    obstacles = {*decision_text.OBSTACLES, "short record"}
    assert obstacles == set(get_args(stability_decision.Obstacle))
    doubt_names = get_type_hints(run_end.EndDoubt)["name"]
    assert set(end_text.END_DOUBTS) == set(get_args(doubt_names))


def test_unequal_scalars_of_kd_pass() -> None:
    checked = check_shipped(sites__m2__control__Kd=6.0)["Kd"]
    assert checked.holds
    assert checked.text == "one Kd up to a scalar: m1 1, m2 2, s 1"


def test_a_hand_that_holds_on_fails_a_premise() -> None:
    still_holding = check_shipped("paper", duration_s=3.0, rate_hz=100)["hands"]
    assert still_holding.holds is False  # until 11 s
    lets_go = check_shipped("paper", duration_s=12.5, rate_hz=100)["hands"]
    assert lets_go.holds
    assert "no pushes after 10.99" in lets_go.text
    briefly = check_shipped("paper", duration_s=11.5, rate_hz=100)["hands"]
    assert briefly.holds is False
    assert "0.5 s of free motion at the end are less than 1 s" in briefly.text


def test_a_damper_of_qd_may_feed_r() -> None:
    hands = next(p for p in make_run("wall").certificate.premises if p.name == "hands")
    assert hands.holds is False
    assert hands.text.startswith("the hands and walls supplied up to")


@pytest.mark.parametrize(
    ("apart_rad", "says"),
    [(0.5, "the walls supplied up to"), (1e-8, "the walls only absorbed energy")],
)
def test_rounding_counts_as_no_energy(apart_rad: float, says: str) -> None:
    """A damper of a motion of 1e-8 rad gives some 1e-17 J to r, hardly less than V of known arms."""
    known = {"control__theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0], "control__Gamma": 0.0}
    starts = {f"sites__{name}__q0_rad": [0.3, 0.4] for name in ("m2", "s")}
    damper = {"sites__m1__environment": [{"kind": "viscous", "damping_nm_s_rad": [3.0, 3.0]}]}
    checked = check_shipped(
        sites__m1__q0_rad=[0.3 + apart_rad, 0.4], **known, **starts, **damper
    )["hands"]
    assert checked.text.startswith(says)
    assert checked.holds is (apart_rad < 1e-3)


SITE = "sites.s.environment"
SAMPLED = {f"{SITE}.0.sampled": True, "rate_hz": 200, "duration_s": 8.0}


def simulate_windup(**changes: object) -> Log:
    """Returns the log of `windup` at a sampled wall."""
    return trilat_net.simulate("windup", {**SAMPLED, **make_overrides(**changes)})


def find_wall_premise(log: Log) -> Premise | None:
    """Returns the premise about sampled walls, or None if a log has no such wall."""
    premises = RunFacts.of_log(log).check_premises()
    return next((premise for premise in premises if premise.name == "walls"), None)


def make_damped_wall(b: float, **more: object) -> list[dict[str, object]]:
    """Returns the wall of `windup` with a damper of the arm."""
    wall = load_scenario("windup").sites["s"].environment[0]
    damper_keys = {
        "point_m": list(wall.point_m),
        "normal": list(wall.normal),
        "stiffness_n_m": wall.stiffness_n_m,
    }
    return [
        {"kind": "wall", "sampled": True, **damper_keys},
        {"kind": "viscous", "damping_nm_s_rad": b, **more},
    ]


def test_sampled_walls_give_half_k_dx_squared() -> None:
    log = simulate_windup()
    wall = log.scenario.sites["s"].environment[0]
    s = log["s"]
    x = np.cos(s.q[:, 0]) + np.cos(s.q.sum(axis=1))
    depth = np.maximum(x - wall.point_m[0], 0.0)
    inside = (depth[:-1] > 0.0) & (depth[1:] > 0.0)
    leaves = (depth[:-1] > 0.0) & (depth[1:] == 0.0)
    gives = 0.5 * wall.stiffness_n_m * float((np.diff(x)[inside] ** 2).sum())
    gives += wall.stiffness_n_m * float(
        (depth[:-1] * -np.diff(x) - 0.5 * depth[:-1] ** 2)[leaves].sum()
    )
    # the spring is there, and nobody pressed it
    enters = (depth[:-1] == 0.0) & (depth[1:] > 0.0)
    gives += 0.5 * wall.stiffness_n_m * float((depth[1:][enters] ** 2).sum())
    wall_energy = WallEnergy.list_of_log(log)[0]
    assert wall_energy.site == "s"
    assert wall_energy.generated_j == pytest.approx(gives, rel=0.02)
    assert wall_energy.required_damping_n_s_m == pytest.approx(0.5 * 2000.0 / 200.0)
    assert wall_energy.arm_damping_n_s_m == 0.0


def test_the_sampled_wall_fails_its_premise_by_name() -> None:
    wall = find_wall_premise(simulate_windup())
    assert wall is not None
    assert (wall.name, wall.holds) == ("walls", False)


@pytest.mark.parametrize(("b", "holds"), [(1.0, False), (40.0, True)])
def test_a_damper_of_the_arm_dissipates_wall_energy(b: float, *, holds: bool) -> None:
    wall = find_wall_premise(
        simulate_windup(**{SITE: make_damped_wall(b), f"{SITE}.0.sampled": True})
    )
    assert wall is not None
    assert wall.holds is holds


def test_a_sampled_damper_alone_may_generate_energy() -> None:
    keys = {f"{SITE}.0.sampled": True, f"{SITE}.0.stiffness_n_m": 0.0}
    wall = find_wall_premise(simulate_windup(**keys, **{f"{SITE}.0.damping_n_s_m": 50.0}))
    assert wall is not None
    assert wall.holds is False


def test_sampled_or_missing_dampers_dissipate_nothing() -> None:
    for more in ({"sampled": True}, {"end_s": 1.0}):
        wall = find_wall_premise(
            simulate_windup(**{SITE: make_damped_wall(40.0, **more), f"{SITE}.0.sampled": True})
        )
        assert wall is not None
        assert wall.holds is False


def test_unreachable_or_continuous_walls_give_no_energy() -> None:
    far_wall = find_wall_premise(simulate_windup(**{f"{SITE}.0.point_m": [1.9, 0.0]}))
    assert far_wall is not None
    assert far_wall.holds
    assert find_wall_premise(simulate_windup(**{f"{SITE}.0.sampled": False})) is None


def most_given(v: Array, ticks: int, K: float, B: float, *, differenced: bool = False) -> float:
    """Returns the least damping b, N s/m, that dissipates the energy of a held wall over a
    motion, h = 1; v at ends of parts.

    The speed is linear over each part; the motion begins and ends at rest in the wall.
    """
    parts = v.reshape(ticks, -1)
    after = np.append(parts[1:, :1], [[0.0]], axis=0)
    ends = np.hstack([parts, after])
    dt = 1.0 / parts.shape[1]
    steps = (0.5 * dt * (ends[:, 1:] + ends[:, :-1])).sum(axis=1)
    taken = (
        dt / 3.0 * (ends[:, 1:] ** 2 + ends[:, 1:] * ends[:, :-1] + ends[:, :-1] ** 2)
    ).sum()
    speed = np.append(0.0, steps[:-1]) if differenced else parts[:, 0]
    return float((0.5 * K * steps**2 - B * speed * steps).sum() / taken)


def test_damping_by_the_sampled_speed_gives_energy() -> None:
    """Ticks of 1 s, K 2, B 1: K h / 2 + B is 2.

    For motions faster than half the tick rate there is no bound.
    """
    ticks = 200
    rng = np.random.default_rng(5)
    t = np.arange(ticks * 400) / 400.0
    square = np.where(t % 2.0 < 1.0, 1.0, -1.0)  # its speed changes sides at each tick
    assert most_given(square, ticks, 2.0, 1.0, differenced=True) == pytest.approx(2.0, rel=0.02)
    harmonics = np.pi * (2.0 * np.arange(20) + 1.0)
    c = np.ones(20) / np.sqrt(20.0)
    s = 1.0 / harmonics / np.linalg.norm(1.0 / harmonics)
    many = (
        c[:, None] * np.cos(harmonics[:, None] * t)
        - s[:, None] * np.sin(harmonics[:, None] * t)
    ).sum(0)
    assert most_given(many, ticks, 0.0, 1.0) == pytest.approx(3.1, abs=0.1)
    for _ in range(50):
        straight = rng.normal(size=ticks)
        assert most_given(straight, ticks, 2.0, 1.0) <= 1.5
        slow = (
            np.sin(np.pi * rng.uniform(0.0, 1.0) * t + rng.uniform(0.0, 6.0))
            * np.sin(np.pi * t / ticks) ** 2
        )
        assert most_given(slow, ticks, 2.0, 1.0) <= 1.0


class PartOfSite(SimpleNamespace):
    """The parts of a site's log on which presence depends."""

    def __len__(self) -> int:
        return len(self.t_s)


class LogOfSites(SimpleNamespace):
    """The parts of a log on which presence depends."""

    def __getitem__(self, site: str) -> PartOfSite:
        return self.parts[site]


def test_two_overlapping_absences_are_both_found() -> None:
    """Site a was away from 1 s to 2 s; site b left at 3 s of 5 s."""
    log = LogOfSites(
        sites=("a", "b"),
        parts={
            "a": PartOfSite(rate_hz=10, last_tick=49, t_s=np.arange(50) / 10.0),
            "b": PartOfSite(rate_hz=10, last_tick=29, t_s=np.arange(30) / 10.0),
        },
        absences={"a": [(10, 19)]},
        events=[SimpleNamespace(about="b", kind="left")],
        scenario=SimpleNamespace(duration_s=5.0),
    )
    spans = AbsentSpan.list_of_log(log)  # type: ignore[arg-type]
    assert spans == [AbsentSpan("a", 1.0, 2.0), AbsentSpan("b", 3.0, 5.0)]


def test_sites_may_end_a_tenth_apart() -> None:
    """A site that left exactly 0.1 s before the end was not absent."""
    spans = {}
    for ticks in (48, 49, 50):
        log = LogOfSites(
            sites=("a", "b"),
            parts={
                "a": PartOfSite(rate_hz=10, last_tick=49, t_s=np.arange(50) / 10.0),
                "b": PartOfSite(rate_hz=10, last_tick=ticks - 1, t_s=np.arange(ticks) / 10.0),
            },
            absences={},
            events=[SimpleNamespace(about="b", kind="left")],
            scenario=SimpleNamespace(duration_s=5.0),
        )
        spans[ticks] = AbsentSpan.list_of_log(log)  # type: ignore[arg-type]
    assert spans == {48: [AbsentSpan("b", 4.8, 5.0)], 49: [], 50: []}


def test_a_stretch_has_only_its_own_delays() -> None:
    """A delay that changes after an absence varies in the later stretch alone."""
    change = {"at_s": 1.0, "link": "m1->s", "to": {"delay_ms": 60.0}}
    log = make_run("free", {**SHORT, "timeline": [change]}).log
    absent = AbsentSpan("m2", 0.5, 0.6)
    facts = RunFacts.of_log(log)
    assert facts.functional is not None
    with_absence = facts.functional._replace(absent=[absent])
    checked = facts._replace(functional=with_absence).check_premises()
    presence = next(premise for premise in checked if premise.name == "presence")
    assert presence.holds is False
    earlier, later = presence.quantities.stretches  # type: ignore[union-attr]
    assert (earlier.to_s, earlier.varying) == (0.5, ())
    assert (later.from_s, later.varying) == (0.6, (("m1", "s"),))


def test_stops_out_of_reach_satisfy_their_premise() -> None:
    """The elbow is far from its stop during the first tenth of a second."""
    log = trilat_net.simulate(parse_scenario(rough_arm_text(), overrides={"duration_s": 0.1}))
    checked = {premise.name: premise for premise in RunFacts.of_log(log).check_premises()}
    assert checked["stops"].holds is True
