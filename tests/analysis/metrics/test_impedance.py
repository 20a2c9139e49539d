"""Ratios over frequency: decided at driven frequencies, undecided elsewhere, never the hand's own."""

import math

import numpy as np
import pytest
from scipy import signal

from tests.analysis.builders import make_run
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.metrics.measured_impedance import FrequencyResponse

RATE_HZ = 200
EVERYTHING = np.ones(60 * RATE_HZ, dtype=np.bool_)


def draw_noise(seed: int) -> np.ndarray:
    white = np.random.default_rng(seed).normal(size=len(EVERYTHING))
    b, a = signal.butter(2, 4.0, fs=RATE_HZ)
    return signal.lfilter(b, a, white)


def estimate_strongest(
    drive: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    usable: np.ndarray,
    rate_hz: int,
    least: float,
) -> FrequencyResponse:
    return FrequencyResponse.estimate(drive, x, y, usable, rate_hz, least)[0]


def test_a_known_filter_is_identified() -> None:
    """Gain and phase of a known system, by SciPy's freqz."""
    b, a = signal.butter(1, 3.0, fs=RATE_HZ)
    x = draw_noise(1)
    response = estimate_strongest(x, x, signal.lfilter(b, a, x), EVERYTHING, RATE_HZ, 1e-3)
    _, H = signal.freqz(b, a, worN=[response.frequency_hz], fs=RATE_HZ)
    assert response.gain == pytest.approx(abs(H[0]), rel=max(0.02, 3.0 * response.error))
    assert response.phase_rad == pytest.approx(float(np.angle(H[0])), abs=0.05)
    assert response.coherence > 0.95


def test_unrelated_signals_are_undecided() -> None:
    x = draw_noise(1)
    response = estimate_strongest(x, x, draw_noise(2), EVERYTHING, RATE_HZ, 1e-3)
    assert response.gain is None
    assert "the coherence" in response.why


def test_one_push_is_not_enough() -> None:
    """A single event is coherent with anything."""
    x = np.where(np.abs(np.arange(len(EVERYTHING)) - 2000) < 100, 1.0, 0.0)
    response = estimate_strongest(x, x, 3.0 * x, EVERYTHING, RATE_HZ, 1e-3)
    assert response.gain is None
    assert "stretches of 4 s" in response.why


def test_weak_drives_and_missing_records_are_named() -> None:
    x = draw_noise(1)
    assert (
        estimate_strongest(0.0 * x, x, x, EVERYTHING, RATE_HZ, 1e-3).why
        == "the drive is too weak at every frequency"
    )
    gaps = EVERYTHING.copy()
    gaps[::700] = False
    assert "no interval of 4 s" in estimate_strongest(x, x, x, gaps, RATE_HZ, 1e-3).why


def test_closed_loop_impedance_depends_on_the_driver() -> None:
    """A spring k held against a damper b that others shake: torque / speed is b + noise's, not
    -k/s.

    The hand's torque is k (x - q), speed qd = (torque + push) / b. By the hand's own script x
    the ratio is b; the plain ratio of the two, without the drive, is far off.
    """
    k = 5.0
    b = 2.0
    h = 1.0 / RATE_HZ
    x = draw_noise(3)
    torque = np.zeros(len(EVERYTHING))
    speed = np.zeros(len(EVERYTHING))

    def shake(push: np.ndarray) -> None:
        q = 0.0
        for n in range(len(x)):
            torque[n] = k * (x[n] - q)
            speed[n] = (torque[n] + push[n]) / b
            q += h * speed[n]

    shake(2.0 * draw_noise(4))
    plain = estimate_strongest(speed, speed, torque, EVERYTHING, RATE_HZ, 1e-6)
    assert plain.gain is None or abs(plain.gain - b) > 0.2 * b
    driven = estimate_strongest(x, speed, torque, EVERYTHING, RATE_HZ, 1e-6)
    assert driven.gain is None  # half of what moves is not the hand's
    shake(0.0 * x)
    alone = estimate_strongest(x, speed, torque, EVERYTHING, RATE_HZ, 1e-6)
    assert alone.gain == pytest.approx(b, rel=1e-6)


def make_shaken_overrides() -> dict[str, object]:
    points = [[0.02 * n, 0.4 * math.sin(2.0 * math.pi * 0.02 * n), 0.0] for n in range(1501)]
    return {
        "control.law": "p_d",
        "control.K": 20.0,
        "control.d": 10.0,
        "arm.g_m_s2": 0.0,
        "link.delay_ms": 100.0,
        "rate_hz": 100,
        "duration_s": 30.0,
        "sites.m.q0_rad": [0.3, 1.2],
        "sites.s.q0_rad": [0.3, 1.2],
        "sites.m.hands": [{"kind": "recorded", "points": points}],
    }


def test_linear_pair_has_its_closed_form_impedance() -> None:
    """Both arms at one pose, small motions: M s^2 + d s + K, coupled by K exp(-s T), driven at joint 1."""
    log = make_run("two_sites", make_shaken_overrides()).log
    (measured_response,) = (
        response
        for response in LogMetrics.of_log(log).responses
        if (response.kind, response.at, response.joint) == ("impedance", "m", 1)
    )
    assert measured_response.ratio.frequency_hz == 1.0
    s = 2j * math.pi
    c2 = math.cos(float(log["m"].q[:, 1].mean()))
    M = np.array([[3.0 + 2.0 * c2, 1.0 + c2], [1.0 + c2, 1.0]])
    own_impedance = M * s**2 + np.eye(2) * (10.0 * s + 20.0)
    far = -20.0 * np.exp(-0.1 * s) * np.eye(2)
    q = np.linalg.solve(
        np.block([[own_impedance, far], [far, own_impedance]]), np.array([1.0, 0.0, 0.0, 0.0])
    )
    Z = 1.0 / (s * q[0])
    assert measured_response.ratio.gain == pytest.approx(abs(Z), rel=0.02)
    assert measured_response.ratio.phase_rad == pytest.approx(float(np.angle(Z)), abs=0.03)


def test_a_still_hand_says_nothing_of_its_site() -> None:
    """`contact`: from 3 s on the wall shakes the arm against a still hand of 30 N m/rad."""
    responses = LogMetrics.of_log(make_run("contact", {"rate_hz": 200}).log).responses
    for response in responses:
        if response.kind == "impedance":
            assert response.ratio.gain is None


def closed_form_impedance(frequency_hz: float, c2: float) -> complex:
    """Returns the impedance of joint 1 of a pair M s^2 + d s + K, coupled by K exp(-s T), gains
    as in `shaken`.
    """
    s = 2j * math.pi * frequency_hz
    M = np.array([[3.0 + 2.0 * c2, 1.0 + c2], [1.0 + c2, 1.0]])
    own_impedance = M * s**2 + np.eye(2) * (10.0 * s + 20.0)
    far = -20.0 * np.exp(-0.1 * s) * np.eye(2)
    q = np.linalg.solve(
        np.block([[own_impedance, far], [far, own_impedance]]), np.array([1.0, 0.0, 0.0, 0.0])
    )
    return complex(1.0 / (s * q[0]))


CHIRP = {"kind": "chirp", "peak_nm": [1.0, 0.0], "from_hz": 0.5, "to_hz": 4.5, "sweep_s": 4.0}
MULTISINE = {
    "kind": "multisine",
    "amplitude_nm": [0.3, 0.0],
    "frequencies_hz": [0.5, 1.25, 2.0, 3.0, 4.0],
}


@pytest.mark.parametrize(("hand", "lines"), [(CHIRP, 15), (MULTISINE, 5)])
def test_an_impedance_is_measured_over_frequency(hand: dict[str, object], lines: int) -> None:
    """At every line the error is below 2 % and two random errors of the closed form, which are larger for a chirp."""
    log = make_run("two_sites", {**make_shaken_overrides(), "sites.m.hands": [hand]}).log
    measured_response = next(
        response
        for response in LogMetrics.of_log(log).responses
        if (response.at, response.joint) == ("m", 1)
    )
    c2 = math.cos(float(log["m"].q[:, 1].mean()))
    assert len(measured_response.spectrum) == lines
    for line in measured_response.spectrum:
        Z = closed_form_impedance(line.frequency_hz, c2)
        assert line.gain == pytest.approx(abs(Z), rel=0.02 + 2.0 * line.error)
        assert line.phase_rad == pytest.approx(float(np.angle(Z)), abs=0.02 + 3.0 * line.error)
        assert line.coherence > (0.998 if hand is MULTISINE else 0.92)
    assert measured_response.ratio in measured_response.spectrum
    assert [line.frequency_hz for line in measured_response.spectrum] == sorted(
        line.frequency_hz for line in measured_response.spectrum
    )
