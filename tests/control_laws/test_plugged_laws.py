"""What holds for every built-in law that is plugged in: bits, replay, the scenario that names it."""

from typing import Any

import pytest

from tests.log_editing import opened, recorded
from tests.virtual_runs import sampled, trajectories
from trilat_net.execution.verify import verify
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.describe import describe_scenario

LAWS: dict[str, tuple[str, dict[str, Any]]] = {
    "six_channel": ("paper", {"control.acceleration": 0.5, "control.force_own": 0.1}),
    "four_channel": ("two_sites", {"control.acceleration": 0.5}),
    "saturated_pd": ("paper", {}),
    "authority": ("paper", {"sites.s.control.leads": False}),
    "impedance": ("paper", {"sites.s.control.follows": True}),
    "sync": ("paper", {}),
    "smith": ("two_sites", {"sites.m.control.predicts": True}),
    "lee_spong": ("paper", {}),
    "adaptive_kinematics": ("paper", {}),
    "adaptive_robust": ("paper", {}),
}
"""Per law a shipped scenario and settings."""
LONG = [name if name == "saturated_pd" else pytest.param(name, marks=pytest.mark.long) for name in LAWS]


def overrides(law: str) -> dict[str, Any]:
    return {"duration_s": 0.12, "link.delay_ms": 20.0, "control.law": law, **LAWS[law][1]}


def scenario(law: str) -> Scenario:
    return load_scenario(LAWS[law][0], overrides(law))


@pytest.mark.parametrize("law", LAWS)
def test_a_scenario_names_it_and_its_check_tells_its_condition(law: str) -> None:
    lines = describe_scenario(scenario(law))
    assert len([line for line in lines if line.startswith("condition of ") and law in line]) >= 1


@pytest.mark.parametrize("law", LONG)
def test_its_runs_are_the_same_bits_by_whatever_driver(law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = scenario(law)
    ticks = trajectories(chosen)
    fused = sampled(chosen, (0.12,))[:, 0]
    names = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")
    columns = chosen.layout(chosen.names[0]).columns()
    for site, row in zip(ticks.sites.values(), fused, strict=True):
        assert all((getattr(site, name)[-1] == row[columns[name]]).all() for name in names)
    kind = getattr(chosen.sites[chosen.names[0]].control, "core_class", None)
    if kind is not None:
        monkeypatch.setattr(kind, "is_compiled", False)
        plain = trajectories(chosen)
        for name in names:
            assert (plain.stack(name) == ticks.stack(name)).all()


@pytest.mark.parametrize("law", LONG)
def test_its_log_is_executed_again(law: str) -> None:
    log = opened(recorded(LAWS[law][0], overrides(law)))
    verdict = verify(log)
    assert verdict.whole_run
    assert verdict.identical == verdict.records
    twins = compare_with_virtual(log)
    assert twins.fed.identical == twins.plain.identical == verdict.records
