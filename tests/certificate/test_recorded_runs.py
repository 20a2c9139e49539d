"""A simulated run is recorded for its energies only if these may change the judgement."""

from collections.abc import Callable
from typing import Any

import pytest

from tests.execution.builders import run_fused
from trilat_net.analysis import judge
from trilat_net.execution import FusedRun, SimulatedLog
from trilat_net.log import Log
from trilat_net.scenario import Scenario, load_scenario

LOSSY = {"link.delay_ms": 50, "link.loss": 0.3, "duration_s": 4.0, "timeline": []}
"""Delays without exact roots, so that a run settles or is open."""


def count_recordings(
    monkeypatch: pytest.MonkeyPatch, name: str, settings: dict[str, Any]
) -> tuple[int, str]:
    """Returns how often a run was recorded to judge it, and the judgement."""
    recorded: list[str] = []

    def count(simulate: Callable[[Scenario], Log]) -> Callable[[Scenario], Log]:
        def simulate_and_count(scenario: Scenario) -> Log:
            recorded.append(scenario.name)
            return simulate(scenario)

        return simulate_and_count

    monkeypatch.setattr(judge, "SimulatedLog", count(SimulatedLog))
    monkeypatch.setattr(FusedRun, "simulate_log", count(FusedRun.simulate_log))
    scenario = load_scenario(name, settings)
    run = run_fused(scenario)
    decision = judge.VirtualRun(scenario, run).decision
    monkeypatch.undo()
    return len(recorded), str(decision.stability)


@pytest.mark.parametrize(
    ("law", "times"),
    [("adaptive", 1), ("tanks", 1), ("p_d", 0)],
)
def test_only_laws_with_energies_are_recorded(
    law: str, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**LOSSY, "scheme": "digital", "control.law": law}
    counted, word = count_recordings(monkeypatch, "free", settings)
    assert word in ("settled", "open")
    assert counted == times


def test_a_long_run_is_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run whose records would fill the memory is judged by its roots and pushes."""
    monkeypatch.setattr(judge, "MAX_RECORDED_TICKS", 11_999)
    counted, _ = count_recordings(monkeypatch, "free", LOSSY)
    assert counted == 0
