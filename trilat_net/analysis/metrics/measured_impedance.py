"""Rendered impedance and reflected wall force over frequency, by a run's frequency response.

Invariant: a response without sufficient excitation is undecided, with a reason. It is given at
the spectral line with the strongest drive, and at all that are driven nearly as much, if at
least `MIN_SEGMENTS` independent segments excite the line and both signals have a coherence of
at least `MIN_COHERENCE` with the
drive: then its random error is at most 17.2 %.

In a closed loop the ratio of two signals depends on the drive, so the drive is a signal of its
own that depends on nothing else: H = S_dy / S_dx. docs/metrics.md names drives and sources
(Welch; Bendat and Piersol; Soderstrom and Stoica).
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.vectors import Array
from ..aligned import Bools, find_latest_rows
from ..run_view import RunView, SiteRun

Complex = NDArray[np.complex128]

SEGMENT_S = 4.0
"""Length of a segment, s: lines are a quarter of a hertz apart."""
_LOWEST_LINE = 2
"""The first line that a Hann window keeps free of the mean."""
HIGHEST_HZ = 20.0
"""Highest line, Hz: operators and arms are slower."""
MIN_COHERENCE = 0.9
MIN_SEGMENTS = 4.0
_OVERLAP_FACTOR = 1.06
"""So many segments under a Hann window count as one if they overlap by half."""
MIN_DRIVE_TORQUE_NM = 0.05
"""Least amplitude of a torque that drives, N m."""
_NEARLY = 0.55
"""Share of the strongest drive from which on a line counts as driven: a Hann window leaks 0.5
to the next.
"""
STILL_SCRIPT_NM_S = 1e-6
"""A script that changes by less stands still, N m/s."""
NO_SCRIPT_TEXT = "what the hand was to do is not in the scenario: nobody knows who drives"


class FrequencyResponse(NamedTuple):
    """Output over input at one frequency; undecided values are None.

    Attributes:
        frequency_hz: the line with the strongest drive.
        gain, phase_rad: of the ratio, in the unit of output over input.
        coherence: the smaller of both signals' coherences with the drive.
        segments: number of segments of equal power that would drive the line as much as all of
            them do.
        error: random error of the gain, one standard deviation as a share of it.
        why: the reason why the ratio is undecided; "" if it is decided.
    """

    frequency_hz: float | None = None
    gain: float | None = None
    phase_rad: float | None = None
    coherence: float | None = None
    segments: float | None = None
    error: float | None = None
    why: str = ""


def estimate_responses(
    drive: Array, put_in: Array, came_out: Array, usable: Bools, rate_hz: int, least: float
) -> list[FrequencyResponse]:
    """Returns the ratio of two signals at the driven lines, that with the strongest drive
    first.

    Driven is a line with a drive of `least` or more; without one, the only entry says so. The
    drive depends on no other signal. Usable are rows that are recorded while no other drive is
    active. Own code in place of `scipy.signal.csd`, which cannot leave out segments with
    unusable rows.
    """
    length = round(SEGMENT_S * rate_hz)
    starts: list[
        int
    ] = []  # of segments with usable rows alone, each half a length after the one before
    if length >= 4 * _LOWEST_LINE:
        unusable = np.concatenate([[0], np.cumsum(~usable)])
        first = np.arange(0, len(usable) - length + 1, length // 2)
        starts = first[unusable[first + length] == unusable[first]].tolist()
    if not starts:
        return [
            FrequencyResponse(
                why=f"no {SEGMENT_S:g} s are recorded in which nobody else drives"
            )
        ]
    D = _spectra(drive, starts, length)
    power = (np.abs(D) ** 2).mean(axis=0)
    if not np.isfinite(power).all():
        return [FrequencyResponse(why="its numbers are too large")]
    strongest = int(power.argmax())
    if math.sqrt(2.0 * power[strongest]) < least:
        return [FrequencyResponse(why="nothing drives it")]
    driven = np.flatnonzero(power >= max(0.5 * least**2, _NEARLY**2 * power[strongest]))
    X, Y = (_spectra(one, starts, length) for one in (put_in, came_out))
    return [
        _estimate_at_line((line + _LOWEST_LINE) / SEGMENT_S, D[:, line], X[:, line], Y[:, line])
        for line in (strongest, *driven[driven != strongest].tolist())
    ]


def _estimate_at_line(
    frequency_hz: float, D: Complex, X: Complex, Y: Complex
) -> FrequencyResponse:
    power = np.abs(D) ** 2
    segments = float(power.sum() ** 2 / (power**2).sum()) / _OVERLAP_FACTOR
    if segments < MIN_SEGMENTS:
        why = f"undecided: {segments:.1f} stretches of {SEGMENT_S:g} s drive {frequency_hz:g} Hz, "
        return FrequencyResponse(
            frequency_hz, segments=segments, why=f"{why}{MIN_SEGMENTS:g} are needed"
        )
    coherence = min(_coherence(D, X), _coherence(D, Y))
    if coherence < MIN_COHERENCE:
        why = f"undecided: the coherence at {frequency_hz:g} Hz is {coherence:.2f}, {MIN_COHERENCE:g} is needed"
        return FrequencyResponse(frequency_hz, coherence=coherence, segments=segments, why=why)
    H = np.vdot(D, Y) / np.vdot(D, X)
    noise = sum(1.0 / _coherence(D, one) - 1.0 for one in (X, Y))
    error = math.sqrt(max(0.0, noise) / (2.0 * segments))
    return FrequencyResponse(
        frequency_hz=frequency_hz,
        gain=float(abs(H)),
        phase_rad=float(np.angle(H)),
        coherence=coherence,
        segments=segments,
        error=error,
    )


def _coherence(D: Complex, X: Complex) -> float:
    power = float(np.vdot(D, D).real * np.vdot(X, X).real)
    return min(1.0, float(abs(np.vdot(D, X)) ** 2) / power) if power > 0.0 else 0.0


def _spectra(signal: Array, starts: list[int], length: int) -> Complex:
    """Returns the lines of every segment above the mean, shape (S, L), under a Hann window.

    Scaled so that the square of a line is the mean square of its sinusoid. No slope is taken
    out: that would bend slow sinusoids too.
    """
    segments = np.stack([signal[n : n + length] for n in starts])
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(length) + 0.5) / length)
    highest = min(int(HIGHEST_HZ * SEGMENT_S), length // 2 - 1)
    scale = math.sqrt(2.0) / window.sum()
    lines: Complex = (
        np.fft.rfft(segments * window, axis=1)[:, _LOWEST_LINE : highest + 1] * scale
    )
    return lines


class ImpedanceEstimate(NamedTuple):
    """An impedance or a reflection over frequency, of a joint, from 1.

    Attributes:
        kind: "impedance": torque of an operator ON its arm over the velocity of the joint: of
            its site and of all behind it, N m s/rad. "reflection": torque that an operator
            feels over the one of the environment ON another arm.
        at, of: the site of the operator, and of a reflection that of the environment, else "".
        ratio: at the line with the strongest drive.
        spectrum: at every driven line, by rising frequency.
    """

    kind: str
    at: str
    of: str
    joint: int
    ratio: FrequencyResponse
    spectrum: tuple[FrequencyResponse, ...] = ()

    @property
    def unit(self) -> str:
        """The unit of the gain."""
        return "" if self.kind == "reflection" else "N m s/rad"


def estimate_impedances(view: RunView) -> list[ImpedanceEstimate]:
    """Returns the impedance at every operator, and its reflection of every environment
    elsewhere.
    """
    runs = view.shared
    operators = [site for site, run in runs.items() if run.torque.operator.any()]
    walls = [site for site, run in runs.items() if run.torque.environment.any()]
    pairs = [(site, "") for site in operators]
    pairs += [(site, wall) for wall in walls for site in operators if site != wall]
    return [one for site, wall in pairs for one in _estimate_joints(runs, site, wall)]


def _estimate_joints(
    runs: Mapping[str, SiteRun], site: str, wall: str
) -> Iterator[ImpedanceEstimate]:
    records, by_source, _ = runs[site]
    script = by_source.script
    usable = _find_still_rows(runs, site, alone=not wall)
    rows, recorded = find_latest_rows(runs[wall or site].records, records.t_s)
    for joint in range(records.qd.shape[1]):
        found = [FrequencyResponse(why=NO_SCRIPT_TEXT)]
        if script is not None and usable is not None:
            usable = usable & records.known
            operator = by_source.operator[:, joint]
            if wall:
                torque = runs[wall].torque.environment[rows, joint]
                signals = torque, torque, -operator, usable & recorded
            else:
                signals = script[:, joint], records.qd[:, joint], operator, usable
            found = estimate_responses(*signals, records.rate_hz, MIN_DRIVE_TORQUE_NM)
        spectrum = sorted(
            (one for one in found if one.frequency_hz), key=lambda one: one.frequency_hz or 0.0
        )
        kind = "reflection" if wall else "impedance"
        yield ImpedanceEstimate(
            kind=kind,
            at=site,
            of=wall,
            joint=joint + 1,
            ratio=found[0],
            spectrum=tuple(spectrum),
        )


def _find_still_rows(runs: Mapping[str, SiteRun], at: str, *, alone: bool) -> Bools | None:
    """Returns at which ticks of a site no operator moves, that of the site included unless
    `alone` drives.

    None if one of them has no script.
    """
    t_s = runs[at].records.t_s
    still = np.ones(len(t_s), dtype=np.bool_)
    for site, (records, torque, _) in runs.items():
        if alone and site == at:
            continue
        if torque.script is None:
            return None
        if len(torque.script) > 1:
            rows, _ = find_latest_rows(records, t_s)
            rate = np.abs(np.gradient(torque.script, axis=0)).max(axis=1) * records.rate_hz
            still &= rate[rows] < STILL_SCRIPT_NM_S
    return still
