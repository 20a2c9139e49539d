"""Rendered impedance and reflected wall force over frequency.

From a run's joint input-output frequency response.

Invariant: a response without sufficient excitation is undecided, with a reason. It is given at the one
spectral line with the strongest drive, if at least `MIN_SEGMENTS` independent segments excite it and both
signals have a coherence of at least `MIN_COHERENCE` with the drive: then its random error is below 17 %.

In a closed loop the ratio of two signals depends on the drive, so the drive is a signal of its own that
depends on nothing else: H = S_dy / S_dx, which is H1 if the input is the drive. An impedance is driven by
the operator's script (torque over velocity alone would be the operator's own impedance if anything else
moves the arm); a reflection is driven by the wall while every operator holds still.

Spectra: Welch, "The use of fast Fourier transform for the estimation of power spectra", IEEE Trans. Audio
and Electroacoustics 15 (1967). Coherence and random error: Bendat and Piersol, "Random Data" (2010),
chapters 6 and 9. Estimate: Soderstrom and Stoica, "System Identification" (1989), chapter 10.
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.two_link_arm import JOINTS
from ...core.vectors import Array
from ..aligned import AlignedRecords, Bools, find_latest_rows
from ..torque_split import TorqueSplit

Complex = NDArray[np.complex128]

SEGMENT_S = 4.0
"""Length of a stretch, s: lines are a quarter of a hertz apart."""
_LOWEST_LINE = 2
"""The first line that a Hann window keeps free of the mean."""
HIGHEST_HZ = 20.0
"""Lines above this are not looked at: hands and arms are slower."""
MIN_COHERENCE = 0.9
MIN_SEGMENTS = 4.0
_OVERLAP_FACTOR = 1.06
"""So many stretches under a Hann window count as one, where they overlap by half."""


class FrequencyResponse(NamedTuple):
    """Output over input at one frequency; what is not decided is None.

    Attributes:
        frequency_hz: the line that was driven most, Hz.
        gain: amplitude of the ratio, in the unit of output over input.
        phase_rad: its phase.
        coherence: share of the power at that line that goes with the drive, of the signal with less of it.
        segments: how many stretches of equal power would drive the line as much as all of them do.
        error: random error of the gain, one standard deviation as a share of it.
        why: why the ratio is undecided; "" where it is decided.
    """

    frequency_hz: float | None = None
    gain: float | None = None
    phase_rad: float | None = None
    coherence: float | None = None
    segments: float | None = None
    error: float | None = None
    why: str = ""


class ResponseSignals(NamedTuple):
    """What a ratio is taken of, shape (K,) each.

    Attributes:
        drive: what follows nothing else.
        put_in: the ratio's input.
        came_out: its output.
        usable: rows that are recorded, and of a time in which nobody else drives.
    """

    drive: Array
    put_in: Array
    came_out: Array
    usable: Bools


def estimate_response(signals: ResponseSignals, rate_hz: int, least: float) -> FrequencyResponse:
    """Returns the ratio of two signals at the line that was driven most.

    Args:
        signals: the signals.
        rate_hz: how many rows a second has.
        least: a drive of a smaller amplitude is none.
    """
    length = round(SEGMENT_S * rate_hz)
    starts = _segment_starts(signals.usable, length)
    if not starts:
        return FrequencyResponse(why=f"no {SEGMENT_S:g} s are recorded in which nobody else drives")
    D = _spectra(signals.drive, starts, length)
    power = (np.abs(D) ** 2).mean(axis=0)
    if not np.isfinite(power).all():
        return FrequencyResponse(why="its numbers are too large")
    line = int(power.argmax())
    if math.sqrt(2.0 * power[line]) < least:
        return FrequencyResponse(why="nothing drives it")
    X, Y = (_spectra(one, starts, length)[:, line] for one in (signals.put_in, signals.came_out))
    return _at_line((line + _LOWEST_LINE) / SEGMENT_S, D[:, line], X, Y)


def _at_line(frequency_hz: float, D: Complex, X: Complex, Y: Complex) -> FrequencyResponse:
    each = np.abs(D) ** 2
    segments = float(each.sum() ** 2 / (each**2).sum()) / _OVERLAP_FACTOR
    if segments < MIN_SEGMENTS:
        why = f"undecided: {segments:.1f} stretches of {SEGMENT_S:g} s drive {frequency_hz:g} Hz, "
        return FrequencyResponse(frequency_hz, segments=segments, why=f"{why}{MIN_SEGMENTS:g} are needed")
    coherence = min(_coherence(D, X), _coherence(D, Y))
    if coherence < MIN_COHERENCE:
        why = (
            f"undecided: the coherence at {frequency_hz:g} Hz is {coherence:.2f}, {MIN_COHERENCE:g} is needed"
        )
        return FrequencyResponse(frequency_hz, coherence=coherence, segments=segments, why=why)
    H = np.vdot(D, Y) / np.vdot(D, X)
    noise = sum(1.0 / _coherence(D, one) - 1.0 for one in (X, Y))
    error = math.sqrt(max(0.0, noise) / (2.0 * segments))
    return FrequencyResponse(frequency_hz, float(abs(H)), float(np.angle(H)), coherence, segments, error)


def _coherence(D: Complex, X: Complex) -> float:
    power = float(np.vdot(D, D).real * np.vdot(X, X).real)
    return min(1.0, float(abs(np.vdot(D, X)) ** 2) / power) if power > 0.0 else 0.0


def _segment_starts(usable: Bools, length: int) -> list[int]:
    """Returns where stretches begin, each half a length after the one before, whose rows are all usable."""
    if length < 4 * _LOWEST_LINE:
        return []
    bad = np.concatenate([[0], np.cumsum(~usable)])
    starts = np.arange(0, len(usable) - length + 1, length // 2)
    whole: list[int] = starts[bad[starts + length] == bad[starts]].tolist()
    return whole


def _spectra(signal: Array, starts: list[int], length: int) -> Complex:
    """Returns the lines of every stretch, shape (S, L), from the first without the mean on: Hann.

    Scaled so that the square of a line is the mean square of its sinusoid. No slope is taken out: that would
    bend slow sinusoids too.
    """
    stretches = np.stack([signal[n : n + length] for n in starts])
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(length) + 0.5) / length)
    highest = min(int(HIGHEST_HZ * SEGMENT_S), length // 2 - 1)
    scale = math.sqrt(2.0) / window.sum()
    lines: Complex = np.fft.rfft(stretches * window, axis=1)[:, _LOWEST_LINE : highest + 1] * scale
    return lines


MIN_DRIVE_TORQUE_NM = 0.05
"""Least amplitude of a torque that drives, N m."""
STILL_SCRIPT_NM_S = 1e-6
"""A script that changes by less stands still, N m/s."""
NO_SCRIPT_TEXT = "what the hand was to do is not in the scenario: nobody knows who drives"


class ImpedanceEstimate(NamedTuple):
    """A ratio over frequency.

    Attributes:
        kind: "impedance": torque of a hand ON its arm over the velocity of the joint: what it feels of its
            site and of all behind it, N m s/rad. "reflection": torque that a hand feels over the one that
            walls do ON another arm.
        at: the site whose hand feels it.
        of: of a reflection the site of the walls, else "".
        joint: which joint, from 1.
        ratio: the ratio.
    """

    kind: str
    at: str
    of: str
    joint: int
    ratio: FrequencyResponse

    @property
    def unit(self) -> str:
        """The unit of the gain."""
        return "" if self.kind == "reflection" else "N m s/rad"


def estimate_impedances(
    found: Mapping[str, AlignedRecords], by: Mapping[str, TorqueSplit]
) -> list[ImpedanceEstimate]:
    """Returns what every hand feels over frequency of its site, and of every wall elsewhere.

    Args:
        found: the sites' records.
        by: who pushed them.
    """
    hands = [site for site in found if by[site].operator.any()]
    walls = [site for site in found if by[site].environment.any()]
    return [
        *(one for site in hands for one in _impedance(found, by, site)),
        *(
            one
            for wall in walls
            for hand in hands
            if hand != wall
            for one in _reflection(found, by, wall, hand)
        ),
    ]


def _impedance(
    found: Mapping[str, AlignedRecords], by: Mapping[str, TorqueSplit], site: str
) -> Iterator[ImpedanceEstimate]:
    track, script = found[site], by[site].script
    others = _still(found, by, track, [name for name in found if name != site])
    for joint in range(JOINTS):
        told = FrequencyResponse(why=NO_SCRIPT_TEXT)
        if script is not None and others is not None:
            torque = by[site].operator[:, joint]
            signals = ResponseSignals(script[:, joint], track.qd[:, joint], torque, track.known & others)
            told = estimate_response(signals, track.rate_hz, MIN_DRIVE_TORQUE_NM)
        yield ImpedanceEstimate("impedance", site, "", joint + 1, told)


def _reflection(
    found: Mapping[str, AlignedRecords], by: Mapping[str, TorqueSplit], wall: str, hand: str
) -> Iterator[ImpedanceEstimate]:
    track = found[hand]
    row, there = find_latest_rows(found[wall], track.t_s)
    nobody = _still(found, by, track, list(found))
    for joint in range(JOINTS):
        told = FrequencyResponse(why=NO_SCRIPT_TEXT)
        if nobody is not None:
            torque = by[wall].environment[row, joint]
            signals = ResponseSignals(
                torque, torque, -by[hand].operator[:, joint], track.known & there & nobody
            )
            told = estimate_response(signals, track.rate_hz, MIN_DRIVE_TORQUE_NM)
        yield ImpedanceEstimate("reflection", hand, wall, joint + 1, told)


def _still(
    found: Mapping[str, AlignedRecords],
    by: Mapping[str, TorqueSplit],
    at: AlignedRecords,
    sites: list[str],
) -> Bools | None:
    """Returns at which ticks of a site no hand of some sites moves, shape (K,); None where nobody knows."""
    still = np.ones(len(at.known), dtype=np.bool_)
    for site in sites:
        script = by[site].script
        if script is None:
            return None
        rows, _ = find_latest_rows(found[site], at.t_s)
        rate = (
            np.abs(np.gradient(script, axis=0)).max(axis=1) * found[site].rate_hz if len(script) > 1 else None
        )
        if rate is not None:
            still &= rate[rows] < STILL_SCRIPT_NM_S
    return still
