"""The loop where a recorded run ended: at several rates, over recorded samples, and of laws with waves."""

import pytest

import trilat_net as tn
from trilat_net.theory.linear_analysis import find_end_pose_roots


def test_of_several_rates_roots_are_exact_and_those_of_scenario() -> None:
    """Both sites end where they start, a millionth apart: folded, as they begin."""
    pair = {
        "sites.m.rate_hz": 40,
        "sites.s.rate_hz": 30,
        "scheme": "digital",
        "control": {"law": "p_d", "K": 50.0, "d": 2.0},
        "link.delay_ms": 0.0,
        "duration_s": 4.0,
        "sites.m.q0_rad": [0.0, 3.141592],
        "sites.s.q0_rad": [0.0, 3.141593],
    }
    found = find_end_pose_roots(tn.simulate("two_sites", pair))
    assert (found.verdict, found.exact) == ("unstable", True)
    assert found.rate_per_s == pytest.approx(0.180, abs=1e-3)
    assert found.text.endswith("rad/s, over the period of 0.1 s")


def test_drawn_delays_have_the_roots_of_samples_in_use() -> None:
    """Its last quarter begins 15 s later than the draws of the linear analysis: they are others."""
    run = {"rate_hz": 200, "duration_s": 40.0}
    found, whole = find_end_pose_roots(tn.simulate("jitter", run)), tn.linear("jitter", run, ports=False)
    assert whole.sampled is not None
    assert whole.sampled.rightmost is not None
    assert (found.verdict, found.exact) == ("stable", False)
    assert found.rate_per_s == pytest.approx(whole.sampled.rightmost.s.real, abs=0.01)
    assert "over 10 s of the delays in use, +- 0.0" in found.text


def test_waves_are_told_in_continuous_time() -> None:
    control = {"law": "wave", "b": 60.0, "K": 50.0, "B": 5.0}
    found = find_end_pose_roots(
        tn.simulate("two_sites", {"scheme": "digital", "control": control, "duration_s": 2.0})
    )
    assert found.text.startswith("this rest: at the edge, 2 of its motions keep their speed, the others -0.")
    assert found.text.endswith(", in continuous time")
