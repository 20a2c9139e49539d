"""A ratio of two signals over frequency, as far as a run decides it.

Law: what was not driven is undecided, never a guess. The ratio is given at the one line of the spectrum that
was driven most, and only if at least `LEAST_SEGMENTS` independent stretches of the run drove it and both
signals are coherent with the drive there by `COHERENT` at least: then its random error is below 17 %.

In a closed loop the ratio of two signals is that of whoever drives them. So the drive is a signal of its
own, which follows nothing else: H = S_dy / S_dx, the joint input-output estimate, which is H1 where the input
is the drive. Spectra after Welch, "The use of fast Fourier transform for the estimation of power
spectra", IEEE Trans. Audio and Electroacoustics 15 (1967); coherence and random error after Bendat and
Piersol, "Random Data" (2010), chapters 6 and 9; the estimate after Soderstrom and Stoica, "System
Identification" (1989), chapter 10.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..certificate.track import Bools
from ..core.arm import Array

Complex = NDArray[np.complex128]

SEGMENT_S = 4.0
"""Length of a stretch, s: lines are a quarter of a hertz apart."""
_LOWEST = 2
"""The first line that a Hann window keeps free of the mean."""
HIGHEST_HZ = 20.0
"""Lines above this are not looked at: hands and arms are slower."""
COHERENT = 0.9
LEAST_SEGMENTS = 4.0
_OVERLAP = 1.06
"""So many stretches under a Hann window count as one, where they overlap by half."""


class Ratio(NamedTuple):
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


class Signals(NamedTuple):
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


def ratio(signals: Signals, rate_hz: int, least: float) -> Ratio:
    """Returns the ratio of two signals at the line that was driven most.

    Args:
        signals: the signals.
        rate_hz: how many rows a second has.
        least: a drive of a smaller amplitude is none.
    """
    length = round(SEGMENT_S * rate_hz)
    starts = _starts(signals.usable, length)
    if not starts:
        return Ratio(why=f"no {SEGMENT_S:g} s are recorded in which nobody else drives")
    D = _spectra(signals.drive, starts, length)
    power = (np.abs(D) ** 2).mean(axis=0)
    if not np.isfinite(power).all():
        return Ratio(why="its numbers are too large")
    line = int(power.argmax())
    if math.sqrt(2.0 * power[line]) < least:
        return Ratio(why="nothing drives it")
    X, Y = (_spectra(one, starts, length)[:, line] for one in (signals.put_in, signals.came_out))
    return _at_line((line + _LOWEST) / SEGMENT_S, D[:, line], X, Y)


def _at_line(frequency_hz: float, D: Complex, X: Complex, Y: Complex) -> Ratio:
    each = np.abs(D) ** 2
    segments = float(each.sum() ** 2 / (each**2).sum()) / _OVERLAP
    if segments < LEAST_SEGMENTS:
        why = f"undecided: {segments:.1f} stretches of {SEGMENT_S:g} s drive {frequency_hz:g} Hz, "
        return Ratio(frequency_hz, segments=segments, why=f"{why}{LEAST_SEGMENTS:g} are needed")
    coherence = min(_coherence(D, X), _coherence(D, Y))
    if coherence < COHERENT:
        why = f"undecided: the coherence at {frequency_hz:g} Hz is {coherence:.2f}, {COHERENT:g} is needed"
        return Ratio(frequency_hz, coherence=coherence, segments=segments, why=why)
    H = np.vdot(D, Y) / np.vdot(D, X)
    noise = sum(1.0 / _coherence(D, one) - 1.0 for one in (X, Y))
    error = math.sqrt(max(0.0, noise) / (2.0 * segments))
    return Ratio(frequency_hz, float(abs(H)), float(np.angle(H)), coherence, segments, error)


def _coherence(D: Complex, X: Complex) -> float:
    power = float(np.vdot(D, D).real * np.vdot(X, X).real)
    return min(1.0, float(abs(np.vdot(D, X)) ** 2) / power) if power > 0.0 else 0.0


def _starts(usable: Bools, length: int) -> list[int]:
    """Returns where stretches begin, each half a length after the one before, whose rows are all usable."""
    if length < 4 * _LOWEST:
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
    lines: Complex = np.fft.rfft(stretches * window, axis=1)[:, _LOWEST : highest + 1] * scale
    return lines
