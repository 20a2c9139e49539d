"""Remarks about a run: motors at their limit, large pushes and late ticks, with their numbers."""

import pytest

from tests.analysis.builders import make_short_log
from tests.log.builders import replace_fields, rewrite_log
from trilat_net import simulate
from trilat_net.analysis.run_remarks import LARGE_PUSH_SHARE, RunCircumstances
from trilat_net.net.messages import State


@pytest.mark.parametrize("ticks", [1, 7, 40])
def test_ticks_at_the_torque_limit_are_counted(ticks: int) -> None:
    log = make_short_log("paper")  # 200 Hz
    limits_nm = {site: log.scenario.sites[site].limits.tau_limit_nm for site in log.sites}

    def saturate(row: State) -> State:
        if row.site == "s" or row.tick >= (ticks if row.site == "m1" else 2 * ticks):
            return row
        return replace_fields(row, tau=[0.0, limits_nm[row.site]])

    remarks = RunCircumstances.of_log(rewrite_log(log, change=saturate)).remarks
    times = f"{ticks / 200:.3g} s and {2 * ticks / 200:.3g} s"
    assert remarks == (f"m1 and m2 were at their torque limit for {times}",)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_pushes_above_half_the_limit_are_named(share: float) -> None:
    log = make_short_log("paper")
    limit_nm = log.scenario.sites["m2"].limits.tau_limit_nm
    push_nm = share * LARGE_PUSH_SHARE * limit_nm
    pushed = rewrite_log(
        log,
        change=lambda row: replace_fields(
            row, tau_x=[-push_nm if row.site == "m2" else 0.0, 0.0]
        ),
    )
    limit = f"(torque limit {limit_nm:g} N m)"
    remark = f"hands or walls pushed m2 joint 1 with up to {push_nm:.3g} N m {limit}"
    assert RunCircumstances.of_log(pushed).remarks == ((remark,) if share > 1.0 else ())


def test_late_ticks_are_counted() -> None:
    log = make_short_log("paper")
    late = rewrite_log(
        log,
        change=lambda row: replace_fields(row, late_us=5000 if row.tick in (3, 9) else 4999),
        keep=lambda row: row.site != "m2",
        driver="live",
    )
    assert RunCircumstances.of_log(late).remarks == (
        "2 ticks of m1 and 2 ticks of s began late, by a period or more",
    )


def test_calm_and_empty_logs_have_no_remarks() -> None:
    log = make_short_log("paper")
    assert RunCircumstances.of_log(log).remarks == ()
    empty = rewrite_log(log, lambda _: False)
    assert RunCircumstances.of_log(empty) == RunCircumstances()


@pytest.mark.parametrize("half_width_ms", [0.0, 2.0, 50.0, 200.0])
@pytest.mark.parametrize("order", ["newest", "in_order"])
def test_ages_unlike_the_stated_delay_are_named(half_width_ms: float, order: str) -> None:
    """The newest sample counts, so that jitter makes the samples in use younger."""
    link = {"model": "uniform", "delay_ms": 200, "half_width_ms": half_width_ms, "order": order}
    log = simulate("two_sites", {"links.m->s": link}, duration_s=4.0)
    part = log["s"]
    has_sample = part.used["m"] >= 0
    mean_ms = float((part.tick - part.used["m"])[has_sample].mean()) * 1e3 / part.rate_hz
    remarks = [
        text for text in RunCircumstances.of_log(log).remarks if "samples in use" in text
    ]
    differs = abs(mean_ms - 200.0) > 10.0
    assert differs == (half_width_ms >= 50.0)
    assert bool(remarks) == differs
    if remarks:
        assert f"on m->s were {mean_ms:.4g} ms old on average" in remarks[0]
        assert ("the newest sample counts" in remarks[0]) == (mean_ms < 200.0)
