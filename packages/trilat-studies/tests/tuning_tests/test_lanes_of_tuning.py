"""Candidates that are computed side by side have the scores of candidates one by one."""

import pytest
from study_builders import record_lane_times, use_lanes, use_single_runs

import trilat_net as tn


def test_lanes_do_not_change_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search with lanes forced on finds what a search without lanes finds."""
    lane_times_s = record_lane_times(monkeypatch)
    use_single_runs(monkeypatch)
    single = tn.tune("free", ["p_d"], budget=6, seeds=2, duration_s=2.3, jobs=1)
    assert not lane_times_s

    use_lanes(monkeypatch)
    together = tn.tune("free", ["p_d"], budget=6, seeds=2, duration_s=2.3, jobs=1)
    assert lane_times_s
    assert together.to_dict() == single.to_dict()


def test_report_names_runs_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A law in plain Python runs one by one beside a law that runs in lanes."""
    use_lanes(monkeypatch)
    result = tn.tune("free", ["p_d", "tests.own_laws:PD"], budget=6, duration_s=0.4, jobs=1)
    note = "note: 6 of 14 runs were computed one by one: control laws in plain Python (6)"
    assert note in list(map(str, result.blocks()))
    assert "alone" not in str(result.to_dict())
