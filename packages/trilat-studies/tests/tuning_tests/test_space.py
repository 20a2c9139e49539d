"""The ranges in which laws are searched, and the knowledge that all laws share."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import make_trio_scenario
from trilat_studies.run_commands import format_toml_value
from trilat_studies.tuning.candidate import TuningScenario
from trilat_studies.tuning.search_space import (
    DEFAULT_LAWS,
    SEARCH_SPACES,
    ModelInformation,
    SearchSpace,
    weigh_joints,
)

from tests.core.chain_references import ChainState, chain_references
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.scenario import load_scenario

MIDDLE = {
    law: {knob.name: (knob.low * knob.high) ** 0.5 for knob in space.knobs}
    for law, space in SEARCH_SPACES.items()
}


HELD = ("tdpa", "tanks", "wave")
"""Laws for torque that is held over a tick."""


@pytest.mark.parametrize("law", sorted(SEARCH_SPACES))
@pytest.mark.parametrize("scenario", ["contact", "free"])
def test_candidates_change_their_law_at_every_site(law: str, scenario: str) -> None:
    """A candidate has its law and the told gravity at each site, and changes nothing else."""
    if law == "p_f" and scenario == "free":
        return
    scheme = ["scheme=digital"] if law in HELD else []
    experiment = TuningScenario.load(scenario, ["limits.tau_limit_nm=60", *scheme])
    candidate = experiment.with_gains(
        SEARCH_SPACES[law], ModelInformation(0.95), MIDDLE[law]
    ).scenario

    for name, site in candidate.sites.items():
        assert site.control.__struct_config__.tag == ("adaptive" if law == "known" else law)
        assert site.limits == experiment.scenario.sites[name].limits
        assert site.limits.tau_limit_nm == 60.0
        if site.control.plugged:
            assert getattr(site.control, "gravity", 0.95) == 0.95
            continue
        known = site.control.gains(candidate.arms[name].theta)
        estimate = known.known if np.any(known.known) else known.theta_hat0
        assert estimate[3:] == pytest.approx(0.95 * candidate.arms[name].theta[3:])

    with_same_control = {name: site.control for name, site in candidate.sites.items()}
    assert candidate.links == experiment.scenario.links
    assert len(with_same_control) == len(experiment.scenario.names)


def test_sites_with_own_control_are_changed_separately() -> None:
    candidate: TuningScenario = TuningScenario.load("contact").with_gains(
        SEARCH_SPACES["p_d"], ModelInformation(), {"K": 31.2, "d": 7.1}
    )
    assert [text.partition("=")[0] for text in candidate.overrides] == [
        "sites.m.control",
        "sites.s.control",
    ]
    free: TuningScenario = TuningScenario.load("free").with_gains(
        SEARCH_SPACES["p_d"], ModelInformation(), {"K": 31.2, "d": 7.1}
    )
    assert (
        free.command
        == "trilat sim free --set 'control={law = \"p_d\", K = 31.2, d = 7.1, gravity = 1}'"
    )


def test_equal_quantities_have_equal_ranges_in_laws() -> None:
    ranges: dict[str, set[tuple[str, float, float]]] = {}
    for space in SEARCH_SPACES.values():
        # of the place, in N s/m
        for knob in space.knobs if space.law != "adaptive_kinematics" else ():
            ranges.setdefault(knob.name.partition("_")[0], set()).add(
                (knob.unit, knob.low, knob.high)
            )
    assert all(len(bounds) == 1 for bounds in ranges.values())
    assert ranges["d"] == {("N m s/rad", *next(iter(ranges["Kp"]))[1:])}


def load_six_joints(state: ChainState, **overrides: object) -> TuningScenario:
    """Returns `six_joints` with two equal start poses."""
    start = {f"sites.{name}.q0_rad": state.q.tolist() for name in ("m1", "m2", "s")}
    settings = {"arm.stops": False, **start, **overrides}
    return TuningScenario.load(
        "six_joints", [f"{key}={format_toml_value(value)}" for key, value in settings.items()]
    )


def test_joints_share_gains_by_inertia_from_pinocchio() -> None:
    """Gains of joints are in the ratio of inertias that Pinocchio computes for the pose."""
    armature = np.array([0.2, 0.2, 0.2, 0.05, 0.05, 0.05])
    for state in chain_references()["arm6"].states:
        inertia = 1.0 / np.diag(np.linalg.inv(state.inertia + np.diag(armature)))
        weights = weigh_joints(load_six_joints(state).scenario)
        assert weights == pytest.approx(inertia / inertia.max(), rel=0.05)  # two digits

        gains = {"Lambda": 2.0, "Kp": 30.0, "Kd": 4.0, "Gamma": 0.5}
        candidate = load_six_joints(state).with_gains(
            SEARCH_SPACES["adaptive"], ModelInformation(), gains
        )
        control = candidate.scenario.sites["m1"].control
        assert control.Kp == pytest.approx(30.0 * np.array(weights))
        assert control.Kd == pytest.approx(4.0 * np.array(weights))
        assert control.Lambda == (2.0,) * 6
        assert sum("control=" in text for text in candidate.overrides) == 1  # one for all sites
    assert weigh_joints(load_scenario("free")) == []


@pytest.mark.parametrize("scheme", ["second_order", "digital"])
@pytest.mark.parametrize("armature_kg_m2", [0.0, 0.001, 0.2])
def test_every_choice_within_ranges_is_a_valid_arm(armature_kg_m2: float, scheme: str) -> None:
    state, *_ = chain_references()["arm6"].states
    small = {"law": "p_d", "K": 1.0, "d": 1e-3}
    experiment = load_six_joints(
        state, scheme=scheme, control=small, **{"arm.armature_kg_m2": armature_kg_m2}
    )
    others = ("p_f", "sync", "adaptive_kinematics", "lee_spong")
    for space in SEARCH_SPACES.values():  # for two sites; for planar arms; K T_max has no range
        if space.law not in others and (scheme == "digital" or space.law not in HELD):
            most = {knob.name: knob.high for knob in space.knobs}
            experiment.with_gains(space, ModelInformation(), most)


def test_the_usual_laws_take_any_number_of_sites() -> None:
    assert [space.law for space in SearchSpace.select((), make_trio_scenario())] == list(
        DEFAULT_LAWS
    )


@pytest.mark.parametrize(
    ("law", "facts"),
    [
        ("adaptiv", ["no law 'adaptiv'", "did you mean 'adaptive'"]),
        ("pdd", ["no law 'pdd'", "did you mean 'pd_d'"]),
        (
            "",
            [
                "no law ''",
                "tuned are adaptive, known, adaptive_box, adaptive_kinematics, adaptive_robust",
            ],
        ),
        ("tests.laws:Adaptive", ["tests.laws:Adaptive has no search ranges", "tune = {"]),
        ("own", ["no law 'own'"]),
    ],
)
def test_untunable_settings_are_refused(law: str, facts: list[str]) -> None:
    with pytest.raises(UsageError) as refused:
        SearchSpace.select([law], make_trio_scenario())
    assert all(fact in str(refused.value) for fact in facts)


def test_force_reflection_is_refused_for_three_sites() -> None:
    with pytest.raises(
        ScenarioError,
        match="between one master and one slave; this scenario has 3 sites, 2 of them",
    ):
        SearchSpace.select(["p_d", "p_f"], load_scenario("free"))
    assert [space.law for space in SearchSpace.select(["p_f"], load_scenario("contact"))] == [
        "p_f"
    ]


SHARES = st.floats(50.0, 150.0)


@given(percent=SHARES)
def test_ranges_hold_the_true_parameters_strictly_inside(percent: float) -> None:
    """The true parameters lie inside the ranges, as V' <= 0 needs; else the law cannot work."""
    scenario = make_trio_scenario()
    truth = scenario.arms["s"].theta
    low, high = ModelInformation.of_gravity(percent).box_sides(scenario, "s")
    assert (np.array(low) < truth).all()
    assert (np.array(high) > truth).all()


@given(percent=SHARES)
def test_candidates_know_equal_gravity_and_no_inertia(percent: float) -> None:
    scenario = make_trio_scenario()
    prior = np.array(ModelInformation.of_gravity(percent).prior(scenario, "m1"))
    # (m1 lc1 + m2 l1, m2 lc2) of point masses at the ends, Eq. (24)
    truth = np.array([2.0, 1.0])
    assert (prior[:3] == 0.0).all()
    assert prior[3:] == pytest.approx(truth * percent / 100.0)


@pytest.mark.parametrize("percent", [0.0, 49.0, 151.0, float("nan"), float("inf")])
def test_impossible_knowledge_is_refused(percent: float) -> None:
    with pytest.raises(UsageError, match="gravity_percent must be from 50 to 150 %"):
        ModelInformation.of_gravity(percent)
