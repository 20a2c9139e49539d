"""Records as columns, whole and marked at gaps; and a function of time for delayed values."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from tests.analysis.builders import make_diverged_log, make_short_log
from tests.log.builders import rewrite_log
from trilat_net.analysis.aligned import RECORD_COLUMNS, AlignedRecords, PeerTrajectory


def test_a_whole_log_keeps_its_records() -> None:
    log = make_short_log("paper")
    for site, track in AlignedRecords.by_site(log, common=True).items():
        assert track.known.all()
        assert track.follows.all()
        assert np.array_equal(track.t_s, log[site].t_s)
        assert all(
            np.array_equal(getattr(track, name), getattr(log[site], name))
            for name in RECORD_COLUMNS
        )
        assert all(
            np.array_equal(track.used[peer], log[site].used[peer]) for peer in log[site].peers
        )


def test_gaps_are_filled_linearly_and_marked() -> None:
    whole = make_short_log("paper")
    log = rewrite_log(whole, lambda state: not (state.site == "s" and 100 <= state.tick < 120))
    track = AlignedRecords.by_site(log, common=True)["s"]
    assert np.flatnonzero(~track.known).tolist() == list(range(100, 120))
    assert track.q[110] == pytest.approx(track.q[99] + 11 / 21 * (track.q[120] - track.q[99]))
    assert np.array_equal(track.q[track.known], log["s"].q)


def test_tracks_end_with_the_last_common_time() -> None:
    log = rewrite_log(
        make_short_log("four"),
        lambda state: (
            (state.site != "a" or state.t_ns >= 5e8)
            and (state.site != "d" or state.t_ns < 12e8)
        ),
    )
    aligned_records = AlignedRecords.by_site(log, common=True)
    assert {site: track.t_s[0] for site, track in aligned_records.items()} == {
        "a": 0.5,
        "b": 0.0,
        "c": 0.0,
        "d": 0.0,
    }
    assert all(1.2 - 0.03 < track.t_s[-1] < 1.2 for track in aligned_records.values())
    assert (
        AlignedRecords.by_site(
            rewrite_log(log, lambda state: state.site != "a" or state.t_ns > 13e8),
            common=True,
        )
        == {}
    )


def test_a_diverged_record_is_left_out() -> None:
    log = make_diverged_log()
    last = {
        site: track.t_s[-1] for site, track in AlignedRecords.by_site(log, common=True).items()
    }
    gone = [site for site in log.sites if log[site].states[-1].mode == "diverged"]
    assert gone
    assert all(last[site] < log[site].t_s[-1] for site in gone)
    assert (
        AlignedRecords.by_site(rewrite_log(log, lambda state: state.site != "s"), common=True)
        == {}
    )


def test_the_past_begins_at_rest() -> None:
    track = AlignedRecords.by_site(make_short_log("four"), common=True)["b"]
    now = PeerTrajectory(track).evaluate(track.t_s)
    before = PeerTrajectory(track).evaluate(np.array([-0.5, -1e-3]))
    assert np.array_equal(now.q, track.q)
    assert np.array_equal(now.qd, track.qd)
    expected = cumulative_trapezoid(track.qd**2, track.t_s, axis=0, initial=0.0)
    assert now.squares == pytest.approx(expected, abs=1e-14)
    assert np.array_equal(before.q, np.tile(track.q[0], (2, 1)))
    assert not before.qd.any()
    assert not before.squares.any()
    assert now.known.all()
    assert before.known.all()


def test_values_between_ticks_are_cubic() -> None:
    track = AlignedRecords.by_site(make_short_log("two_sites"), common=True)["m"]
    t_s = track.t_s
    track.q[:] = np.stack([t_s**3 - t_s, 2.0 - t_s**2], axis=1)
    track.qd[:] = np.stack([3 * t_s**2 - 1.0, -2.0 * t_s], axis=1)
    at_s = np.linspace(0.0, t_s[-1], 997)
    assert PeerTrajectory(track).evaluate(at_s).q == pytest.approx(
        np.stack([at_s**3 - at_s, 2.0 - at_s**2], axis=1)
    )


def test_values_in_a_gap_are_not_recorded() -> None:
    whole = make_short_log("paper")
    log = rewrite_log(whole, lambda state: not (state.site == "m1" and state.tick == 100))
    at_s = np.array([98.0, 99.0, 99.5, 100.0, 100.5, 101.0, 102.0]) / 200
    known = PeerTrajectory(AlignedRecords.by_site(log, common=True)["m1"]).evaluate(at_s).known
    assert known.tolist() == [True, True, False, False, False, True, True]
