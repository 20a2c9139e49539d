"""The final loop of a run and its roots (docs/studies/linear.md; docs/reference/stability.md, "Exact roots")."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import trilat_net as tn
from tests.execution.builders import make_log_with_commands, run_fused
from trilat_net.analysis.delay_period import DelayPeriod, find_burst_interval_s
from trilat_net.analysis.judge import certify_run
from trilat_net.analysis.run_end import RunEnd
from trilat_net.analysis.theory.loop_roots import find_log_roots, find_run_roots
from trilat_net.analysis.timeline import Timeline
from trilat_net.scenario import Scenario, load_scenario

PAIR = {
    "arm.g_m_s2": 0.0,
    "control": {"law": "p_d", "K": 10.0, "d": 2.0},
    "rate_hz": 200,
    "sites.m.hands": [],
    "sites.m.q0_rad": [0.3, 0.1],
    "sites.s.q0_rad": [0.299, 0.1],
}


def make_sine_overrides(period_s: float, **more: float) -> dict[str, Any]:
    return {
        "model": "sine",
        "delay_ms": 200.0,
        "amplitude_ms": 195.0,
        "period_s": period_s,
        **more,
    }


def make_pair_scenario(**overrides: Any) -> Scenario:
    return load_scenario("two_sites", {**PAIR, **overrides})


def looped_trace(folder: Path, period_s: float) -> dict[str, Any]:
    """Returns delays of 60 ms, and of 400 ms in the last tenth of the period."""
    times_s = np.arange(0.0, period_s, 0.01)
    delays_ms = np.where(times_s < 0.9 * period_s, 60.0, 400.0)
    rows = [f"{t:.2f},{delay:.3f}" for t, delay in zip(times_s, delays_ms, strict=True)]
    (folder / "trace.csv").write_text("t_s,delay_ms\n" + "\n".join(rows) + "\n")
    return {"model": "trace", "file": str(folder / "trace.csv"), "at_end": "loop"}


def measure_growth(scenario: Scenario, until_s: float) -> float:
    """Returns the growth of the logarithm of the largest |qd| per second, over the last 3/4 of
    a long run.

    A least-squares line through the maxima of 1 s averages over the beat between the motion and
    the period of the delays.
    """
    run = run_fused(scenario, until_s)
    speeds = np.max([buckets[:, 2:4].max(axis=1) for buckets in run.buckets], axis=0)
    seconds = len(speeds) // 20
    maxima = speeds[: 20 * seconds].reshape(seconds, 20).max(axis=1)
    start = seconds // 4
    slope, _ = np.polyfit(np.arange(start, seconds), np.log(maxima[start:]), 1)
    return float(slope)


@given(
    periods=st.lists(st.sampled_from([480, 500, 600, 605, 1210, 1400]), min_size=1, max_size=2),
    rate_hz=st.sampled_from([100, 200]),
)
def test_common_period_is_the_least_common_multiple(periods: list[int], rate_hz: int) -> None:
    """The shortest time that is a whole number of ticks and of every period of a delay."""
    links = {
        f"links.{link}": make_sine_overrides(period / 1000.0)
        for link, period in zip(("m->s", "s->m"), periods, strict=False)
    }
    period = DelayPeriod.of_scenario(make_pair_scenario(rate_hz=rate_hz, **links))
    tick = Fraction(1, rate_hz)
    cycles = [Fraction(ms, 1000) for ms in periods]
    smallest = next(
        k * tick
        for k in range(1, 10**6)
        if all((k * tick / c).denominator == 1 for c in cycles)
    )
    assert period.true_s == pytest.approx(float(smallest), rel=1e-12)


@pytest.mark.parametrize(
    "link",
    [
        {"model": "uniform", "delay_ms": 20.0, "half_width_ms": 10.0},
        {"model": "constant", "delay_ms": 20.0, "loss": 0.1},
    ],
)
def test_random_delays_have_no_period(link: dict[str, Any]) -> None:
    assert DelayPeriod.of_scenario(make_pair_scenario(link=link)).true_s is None


def test_bursts_are_spaced_by_their_losses() -> None:
    """Bursts of 20 samples that lose one sample in five begin every 100 samples."""
    rng = np.random.default_rng(4)
    for burst, loss, share in ((20.0, 0.2, 1.0), (8.0, 0.1, 0.95)):
        link = {
            "model": "constant",
            "delay_ms": 20.0,
            "loss": loss,
            "loss_burst": burst,
            "loss_bad": share,
        }
        scenario = make_pair_scenario(link=link)
        leave = 1.0 - (1.0 - 1.0 / burst) / share
        enter = leave * loss / (share - loss)
        bad = False
        starts = 0
        samples = 200_000
        for draw in rng.random(samples):
            starts += not bad and draw < enter
            bad = draw >= leave if bad else draw < enter
        expected_s = samples / starts / scenario.sites["m"].rate_hz
        assert find_burst_interval_s(scenario) == pytest.approx(expected_s, rel=0.05)
    assert find_burst_interval_s(make_pair_scenario()) is None


def test_two_sinusoids_grow_over_their_common_period() -> None:
    """0.6 s and 0.7 s repeat after 4.2 s; one more second of delay makes the pair grow."""
    links = {"links.m->s": make_sine_overrides(0.6), "links.s->m": make_sine_overrides(0.7)}
    scenario = make_pair_scenario(**{"control.d": 1.2, "duration_s": 20.0, **links})
    roots = find_log_roots(tn.simulate(scenario))
    assert roots.exact
    assert "over the period of 4.2 s" in roots.text
    assert roots.rate_per_s == pytest.approx(measure_growth(scenario, 84.0), abs=2e-3)


@pytest.mark.parametrize("d", [0.75, 1.3])
def test_looped_trace_is_decided_over_its_period(d: float, tmp_path: Path) -> None:
    """A run of 1.4 periods does not decide; the record of one period repeats for ever."""
    link = looped_trace(tmp_path, 10.0)
    scenario = make_pair_scenario(**{"control.d": d, "duration_s": 14.0, "link": link})
    certificate = certify_run(tn.simulate(scenario))
    roots = certificate.roots
    assert roots is not None
    assert roots.exact
    assert "over the period of 10 s" in roots.text
    assert roots.rate_per_s == pytest.approx(measure_growth(scenario, 400.0), abs=2e-3)
    assert roots.rate_per_s is not None
    assert str(certificate.stability) == ("stable" if roots.rate_per_s < 0.0 else "not stable")
    assert "exact roots" in certificate.decision.rests_on
    assert str(tn.linear(scenario, ports=False).verdict) == roots.verdict


def test_trace_that_has_ended_is_its_last_delay(tmp_path: Path) -> None:
    link = {**looped_trace(tmp_path, 4.0), "at_end": "hold"}
    damped = {"control.d": 4.0, "duration_s": 8.0}
    ended = find_log_roots(tn.simulate(make_pair_scenario(link=link, **damped)))
    constant = {"model": "constant", "delay_ms": 400.0}
    settled = find_log_roots(tn.simulate(make_pair_scenario(link=constant, **damped)))
    assert ended.exact
    assert ended.rate_per_s == pytest.approx(settled.rate_per_s, abs=1e-5)


def test_log_and_fused_run_have_the_same_roots() -> None:
    scenario = make_pair_scenario(duration_s=10.0)
    run = run_fused(scenario, 10.0)
    assert find_run_roots(scenario, run) == find_log_roots(tn.simulate(scenario))


JITTER = {"model": "uniform", "delay_ms": 30.0, "half_width_ms": 20.0}
LOSSY = {"model": "uniform", "delay_ms": 60.0, "half_width_ms": 30.0, "loss": 0.2}


@pytest.mark.parametrize(
    "links",
    [
        {"links.m->s": {**LOSSY, "outages_s": [[1.0, 1.5], [3.6, 3.9]]}},
        {"timeline": [{"at_s": 2.0, "link": "m->s", "to": LOSSY}]},
        {"timeline": [{"at_s": 3.5, "link": "s->m", "to": LOSSY}], "sites.m.rate_hz": 500},
    ],
)
def test_changed_random_links_have_the_logs_roots(links: dict[str, Any]) -> None:
    """The samples in use are drawn with the outages and changes, also beyond the duration."""
    scenario = make_pair_scenario(**{"link": JITTER, "duration_s": 4.0, **links})
    run = run_fused(scenario, 0.0)
    for until_s in (4.0, 5.0):
        run.advance_to(until_s)
        log = tn.simulate(
            make_pair_scenario(**{"link": JITTER, "duration_s": until_s, **links})
        )
        roots = find_run_roots(scenario, run)
        assert roots.verdict
        assert roots == find_log_roots(log)


def test_arms_that_hold_have_no_roots() -> None:
    scenario = make_pair_scenario(
        **{
            "duration_s": 3.0,
            "links.m->s": {"model": "constant", "delay_ms": 30.0, "outages_s": [[2.0, 9.0]]},
            "sites.s.on_stale": {"action": "hold", "age_ms": 300.0},
        }
    )
    run = run_fused(scenario)
    roots = find_run_roots(scenario, run)
    assert roots == find_log_roots(tn.simulate(scenario))
    assert "s ends in the mode 'hold'" in roots.text


SLOWER = {"link": "m->s", "to": {"model": "constant", "delay_ms": 300.0}}
SAME = {"link": "m->s", "to": {"model": "constant", "delay_ms": 200.0}}


def test_command_that_changes_nothing_changes_nothing() -> None:
    """The command changes the delay from 200 ms to 200 ms, and sets the same factors again."""
    scenario = make_pair_scenario(**{"link.delay_ms": 200.0, "duration_s": 14.0})
    same_shares = {"dominance": "s", "to": dict(scenario.dominance["s"]), "ramp_s": 0.0}
    log = make_log_with_commands(scenario, "s", (9.0, SAME), (9.5, same_shares))
    plain = tn.simulate(scenario)
    assert log.changes("s")
    assert Timeline(log).effective_commands == []
    assert RunEnd.of_log(log) == RunEnd.of_log(plain)
    assert find_log_roots(log) == find_log_roots(plain)
    commanded = certify_run(log).decision
    planned = certify_run(plain).decision
    assert commanded.stability is planned.stability
    assert (commanded.rests_on, commanded.reasons) == (planned.rests_on, planned.reasons)


def test_roots_follow_the_last_command() -> None:
    scenario = make_pair_scenario(**{"link.delay_ms": 200.0, "duration_s": 14.0})
    log = make_log_with_commands(scenario, "s", (3.0, SLOWER))
    final = Timeline(log).final_scenario
    assert [change.link for change in final.timeline] == ["m->s"]
    slower = make_pair_scenario(
        **{"link.delay_ms": 200.0, "links.m->s": SLOWER["to"], "duration_s": 14.0}
    )
    expected = find_log_roots(tn.simulate(slower)).rate_per_s
    assert find_log_roots(log).rate_per_s == pytest.approx(expected, abs=1e-5)
    back = make_log_with_commands(scenario, "s", (3.0, SLOWER), (5.0, SAME))
    assert len(Timeline(back).effective_commands) == 2
    unchanged = find_log_roots(tn.simulate(scenario)).rate_per_s
    assert find_log_roots(back).rate_per_s == pytest.approx(unchanged, abs=1e-5)


def test_short_runs_have_the_whole_traces_roots(tmp_path: Path) -> None:
    """The delays are constant in the run, and long in the last tenth of the period."""
    link = looped_trace(tmp_path, 20.0)
    short, whole = (
        find_log_roots(tn.simulate(make_pair_scenario(link=link, duration_s=seconds)))
        for seconds in (10.0, 45.0)
    )
    assert short.exact
    assert short.rate_per_s == pytest.approx(whole.rate_per_s, rel=0.02)


def test_theorems_prove_nothing_for_later_delay_changes(
    tmp_path: Path,
) -> None:
    link = looped_trace(tmp_path, 60.0)
    law = {"duration_s": 20.0}
    lasting, changing = (
        certify_run(tn.simulate(load_scenario("free", {**law, **delays})), twins=0)
        for delays in ({"link.delay_ms": 60.0}, {"link": link})
    )
    assert lasting.has_lasting_delays
    assert not changing.has_lasting_delays
    assert not any("theorem" in proof for proof in changing.proofs)
