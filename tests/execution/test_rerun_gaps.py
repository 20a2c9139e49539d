"""Reruns over missing records: the executed ticks, the copied records, and the message."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.execution.builders import all_identical, list_tick_results, make_log_without
from tests.execution.deliveries import (
    SITES,
    TICKS,
    Sample,
    draw_gaps,
    first_in_first_out,
    make_delivered_bytes,
    site_sets,
    under_way,
)
from tests.log.builders import edit_log_bytes, make_log, make_log_bytes, open_bytes
from trilat_net.errors import LogError
from trilat_net.execution.what_if import rerun


@settings(max_examples=15)
@given(lost=draw_gaps(25), replace=site_sets, delays=under_way)
def test_reruns_continue_behind_a_gap(
    lost: dict[str, set[int]], replace: list[str], delays: dict[Sample, int]
) -> None:
    log = make_log_without(lost, make_delivered_bytes(first_in_first_out(delays)))
    again = rerun(log, replace)
    assert again.identical
    for name, effect in again.sites.items():
        assert effect.identical + effect.stands == len(log[name])
        assert list_tick_results(again.after, name) == list_tick_results(log, name)


@pytest.mark.long
@settings(max_examples=15)
@given(
    replace=site_sets,
    lost=st.sets(st.integers(1, TICKS - 2), min_size=1, max_size=50),
    data=st.data(),
)
def test_changed_sites_pass_through_gaps(
    replace: list[str], lost: set[int], data: st.DataObject
) -> None:
    """Arrivals without record are inferred, correctly as long as no sample was late."""
    gapped = data.draw(st.sampled_from(replace))
    changes = {"control.Kd": 5.0}
    whole = rerun(make_log("free"), replace, changes)
    again = rerun(
        make_log_without({gapped: sorted(lost)}, make_log_bytes("free")), replace, changes
    )
    assert again.sites[gapped].assumed == len(lost)
    assert any("assumed" in note for note in again.notes)
    for name in replace:
        assert list_tick_results(again.after, name) == list_tick_results(whole.after, name)


@pytest.mark.parametrize(
    "changes", [{}, {"control.Kd": 5.0}], ids=["nothing changed", "changed"]
)
def test_late_logs_are_executed_where_possible(changes: dict[str, float]) -> None:
    """Every recorder began at tick 40: with samples 20 ms old, from tick 61 on all in use are known."""
    log = make_log_without({site: range(40) for site in SITES}, make_log_bytes("free"))
    again = rerun(log, ["s"], changes)
    effect = again.sites["s"]
    assert 20 <= effect.stands <= 24
    assert effect.stands + effect.executed == len(log["s"]) == 80
    assert any("are copied unchanged" in note for note in again.notes)
    assert again.identical is not bool(changes)
    first = 40 + effect.stands
    assert (
        list_tick_results(again.after, "s")[: effect.stands]
        == list_tick_results(log, "s")[: effect.stands]
    )
    if changes:
        assert effect.first is not None
        assert effect.first.tick == first  # the gain acts from there


def test_arrivals_missing_in_the_log_are_reported() -> None:
    again = rerun(make_log_without({"m1": range(30, 35)}), ["s"], {"control.Kd": 5.0})
    assert again.sites["s"].lacking == 5
    assert any("5 samples that arrived are not in the log" in note for note in again.notes)


def test_too_few_records_refuse_a_changed_rerun() -> None:
    log = make_log_without({"s": range(10, 110)})
    with pytest.raises(LogError, match="20 of 120 ticks: too few"):
        rerun(log, ["s"], {"control.Kd": 5.0})
    assert rerun(log, ["s"]).identical


def test_late_logs_keep_their_rates() -> None:
    log = make_log_without({site: range(40) for site in SITES})
    with pytest.raises(LogError, match="begin at tick 40"):
        rerun(log, [], {"rate_hz": 500}, closed_loop=True)


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_torn_logs_are_executed_until_their_tear(share: float) -> None:
    data = edit_log_bytes(make_log_bytes("paper"), chunk_bytes=2048)
    log = open_bytes(data[: int(share * len(data))])
    again = rerun(log, ["s"])
    assert all_identical(again)
    assert any("is incomplete" in note for note in again.notes)
    assert 0 < rerun(log, [], {"control.Kd": 5.0}, closed_loop=True).sites["s"].executed < TICKS


def test_a_log_without_records_has_nothing_to_execute() -> None:
    log = make_log_without({site: range(TICKS) for site in SITES})
    again = rerun(log, SITES, {"control.Kd": 5.0})
    assert (again.sites["s"].executed, again.sites["s"].error_rms_rad) == (0, None)
    assert "s: nothing could be executed" in again.notes
    assert len(again.after["s"]) == 0
