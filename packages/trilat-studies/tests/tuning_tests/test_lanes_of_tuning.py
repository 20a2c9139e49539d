"""Candidates that are computed side by side have the scores of candidates one by one."""

import pytest

import trilat_net as tn
from trilat_net.execution.lanes import run_groups
from trilat_net.execution.lanes.lane_run import LaneRun


def test_lanes_do_not_change_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search with lanes forced on finds what a search without lanes finds."""
    calls = []
    advance_to = LaneRun.advance_to

    def count_calls(lanes: LaneRun, until_s: float) -> None:
        calls.append(until_s)
        advance_to(lanes, until_s)

    monkeypatch.setattr(LaneRun, "advance_to", count_calls)
    reports = []
    for has_code in (True, False):
        monkeypatch.setattr(run_groups, "has_lane_code", lambda _, has=has_code: has)
        calls.clear()
        result = tn.tune("free", ["p_d"], budget=6, seeds=2, duration_s=2.3, jobs=1)
        reports.append(result.to_dict())
        assert bool(calls) is has_code
    assert reports[0] == reports[1]


def test_report_names_runs_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A law in plain Python runs one by one beside a law that runs in lanes."""
    monkeypatch.setattr(run_groups, "has_lane_code", lambda _: True)
    found = tn.tune("free", ["p_d", "tests.own_laws:PD"], budget=6, duration_s=0.4, jobs=1)
    note = "note: 6 of 14 runs were computed one by one: control laws in plain Python (6)"
    assert note in list(map(str, found.blocks()))
    assert "alone" not in str(found.to_dict())
