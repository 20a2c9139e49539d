"""Errors, spread and following, for motions whose figures are known in closed form."""

import math

import numpy as np
import pytest

from tests.analysis.builders import make_pair_log, make_short_log
from tests.log.builders import rewrite_log
from trilat_net.analysis.aligned import AlignedRecords
from trilat_net.analysis.dominance_history import DominanceHistory
from trilat_net.analysis.metrics.log_metrics import LogMetrics

RATE_HZ = 200


def test_rms_and_peak_of_a_sinusoid() -> None:
    """A sin(w t) over whole periods has the RMS A / sqrt(2)."""

    def motion(site: str, t_s: float) -> dict[str, list[float]]:
        size = 0.3 if site == "s" else 0.1
        wave = size * math.sin(2.0 * math.pi * t_s)
        return {"q": [1.0 + wave, 2.0 + 0.5 * wave], "q_des": [1.0, 2.0]}

    sites = LogMetrics.of_log(make_pair_log(motion)).sites
    assert sites["s"]["rms_error_rad"].value == pytest.approx(0.3 / math.sqrt(2.0), rel=1e-9)
    assert sites["m"]["rms_error_rad"].value == pytest.approx(0.1 / math.sqrt(2.0), rel=1e-9)
    assert sites["s"]["max_error_rad"].value == pytest.approx(0.3, rel=1e-12)


def test_settling_is_the_last_time_above_the_limit() -> None:
    """exp(-t) sinks below 0.01 rad at t = ln 100."""
    log = make_pair_log(
        lambda _, t_s: {"q": [math.exp(-t_s), 0.0], "q_des": [0.0, 0.0]}, seconds=6.0
    )
    figures = LogMetrics.of_log(log).sites["m"]
    assert figures["settle_s"].value == pytest.approx(math.log(100.0), abs=1.0 / RATE_HZ)
    assert figures["max_error_end_rad"].value == pytest.approx(
        math.exp(-5.0), rel=2.0 / RATE_HZ
    )


def test_an_unsettled_run_is_reported() -> None:
    metrics = LogMetrics.of_log(
        make_pair_log(lambda _, __: {"q": [0.5, 0.0], "q_des": [0.0, 0.0]})
    )
    settled = metrics.sites["m"]["settle_s"]
    assert settled.value is None
    assert "exceeds 0.01 rad" in settled.why


def test_following_allows_for_delay_unlike_spread() -> None:
    """A slave that is exactly its master's past: q_m(t - T) - q_s is zero, and the spread is v T."""
    speed = 0.4
    delay_s = 0.05

    def motion(site: str, t_s: float) -> dict[str, list[float]]:
        past = t_s if site == "m" else max(0.0, t_s - delay_s)
        return {"q": [speed * past, -0.5 * speed * past]}

    metrics = LogMetrics.of_log(make_pair_log(motion))
    assert metrics.links["m->s"]["following_max_rad"].value == pytest.approx(0.0, abs=1e-12)
    assert metrics.run["spread_max_rad"].value == pytest.approx(speed * delay_s, rel=1e-9)
    assert metrics.run["spread_end_rad"].value == pytest.approx(speed * delay_s, rel=1e-9)
    assert metrics.links["s->m"]["following_max_rad"].value is None
    assert not metrics.links["s->m"]["following_max_rad"].applies


def test_undelayed_error_includes_what_the_delay_costs() -> None:
    """A slave at q_m(t - T), with q_m = v t, has e = 0 and the undelayed error v T, as its master has."""
    speed = 0.4
    delay_s = 0.05

    def motion(site: str, t_s: float) -> dict[str, list[float]]:
        past = t_s if site == "m" else max(0.0, t_s - delay_s)
        angles = [speed * past, -0.5 * speed * past]
        return {"q": angles, "q_des": angles}

    sites = LogMetrics.of_log(make_pair_log(motion)).sites
    assert sites["s"]["max_error_rad"].value == 0.0
    for site in ("m", "s"):
        assert sites[site]["undelayed_max_rad"].value == pytest.approx(
            speed * delay_s, rel=1e-9
        )
        assert sites[site]["undelayed_end_rad"].value == pytest.approx(
            speed * delay_s, rel=1e-9
        )
        assert not sites[site]["undelayed_max_m"].applies


def test_undelayed_error_weighs_peers_by_dominance() -> None:
    """During a handover, the slave's undelayed error is q_s - sum_j alpha_sj(t) q_j, at every tick."""
    log = make_short_log("handover")
    sites = LogMetrics.of_log(log).sites
    alpha = DominanceHistory.of_log(log, "s", log["s"].t_s).alpha
    peers = log.scenario.peers("s")
    mean = sum(alpha[:, n, np.newaxis] * log[peer].q for n, peer in enumerate(peers))
    error = np.abs(log["s"].q - mean)
    assert np.ptp(alpha) != 0.0
    assert sites["s"]["undelayed_max_rad"].value == pytest.approx(error.max(), rel=1e-12)


def test_undelayed_error_keeps_to_common_times() -> None:
    """If q_s = q_m - t for 2 s, the error over the times of a run of 1 s is the one at 1 s."""

    def motion(site: str, t_s: float) -> dict[str, list[float]]:
        return {"q": [-t_s if site == "s" else 0.0, 0.0]}

    short = make_pair_log(motion, seconds=1.0)
    long = make_pair_log(motion, seconds=2.0)
    end_s = short["s"].t_s[-1]
    for log, other in ((long, short), (short, long)):
        maxima = LogMetrics.find_undelayed_maxima(log, ["s"], other)
        assert maxima["s"] == pytest.approx(end_s)
    assert LogMetrics.find_undelayed_maxima(long, ["s"])["s"] > 1.9


def test_following_uses_the_delay_in_use() -> None:
    """If older samples are in use than the link states, the master's angles are those of their stamps."""

    def motion(site: str, t_s: float) -> dict[str, object]:
        tick = round(t_s * RATE_HZ)
        used = {"m": max(-1, tick - 37)} if site == "s" else {"s": max(-1, tick - 10)}
        return {"q": [t_s, 0.0], "used": used}

    figures = LogMetrics.of_log(make_pair_log(motion)).links["m->s"]
    assert figures["following_rms_rad"].value == pytest.approx(37 / RATE_HZ, rel=1e-9)
    assert figures["age_mean_ms"].value == pytest.approx(37 / RATE_HZ * 1e3, rel=1e-9)


def test_instants_with_a_missing_record_do_not_count() -> None:
    def motion(site: str, t_s: float) -> dict[str, list[float]]:
        error_rad = 5.0 if site == "s" and 1.0 <= t_s < 1.5 else 0.25
        return {"q": [error_rad if site == "s" else 0.0, 0.0]}

    whole = make_pair_log(motion)
    torn = rewrite_log(whole, lambda state: not (state.site == "m" and 200 <= state.tick < 300))
    assert LogMetrics.of_log(whole).run["spread_max_rad"].value == 5.0
    assert LogMetrics.of_log(torn).run["spread_max_rad"].value == 0.25


def test_the_latest_record_is_the_last_tick() -> None:
    track = AlignedRecords.by_site(make_pair_log(lambda _, __: {}))["m"]
    row, exists = track.find_latest_rows(np.array([0.0, 0.0049, 0.005, 3.995, 4.0, -0.1]))
    assert row.tolist() == [0, 0, 1, 799, 799, 0]
    assert exists.tolist() == [True, True, True, True, False, False]
