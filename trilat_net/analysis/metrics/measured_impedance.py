"""Estimates the impedance that an operator feels at an arm from the records of a run.

The impedance is the ratio of the operator's torque to the velocity of the arm, as a function of
frequency: a large impedance feels stiff or heavy. The module also estimates the force
reflection, which is the fraction of the environment's torque on another arm that reaches the
operator.

In a closed loop, the two signals x and y of such a ratio depend on each other, and their plain
ratio would be biased. The estimate therefore needs a third signal d, the drive, which depends
on no other signal, such as the operator's planned torque. The ratio y / x at a frequency is
S_dy / S_dx, where S is a cross-spectrum. docs/reference/metrics.md names the drives and the
literature.

Invariant:
    - A ratio is reported at the frequency with the strongest drive, and at all frequencies
      whose drive is at least 0.55 times as strong.
    - A ratio is accepted only if at least `MIN_SEGMENTS` independent segments of the run excite
      the frequency, and if both signals have a coherence of at least `MIN_COHERENCE` with the
      drive. These two limits keep its relative random error to at most 17.2 %.
    - Otherwise the reason is reported instead of the ratio.
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core import Array
from ..aligned import Bools
from ..run_view import RunView, SiteRun

Complex = NDArray[np.complex128]

SEGMENT_S = 4.0
"""Length of a segment, in s. Spectral lines are a quarter of a hertz apart."""
_LOWEST_LINE = 2
"""Index of the first spectral line into which a Hann window does not leak the mean."""
HIGHEST_HZ = 20.0
"""Highest frequency of a response, in Hz. Operators and arms are slower."""
MIN_COHERENCE = 0.9
"""Least coherence of both signals with the drive."""
MIN_SEGMENTS = 4.0
"""Least number of independent segments that excite a spectral line."""
_OVERLAP_FACTOR = 1.06
"""Number of overlapping segments that are worth one independent segment.

Segments overlap by half, and are weighted by a Hann window.
"""
MIN_DRIVE_TORQUE_NM = 0.05
"""Least amplitude of a torque that serves as a drive, in N m."""
_DRIVEN_SHARE = 0.55
"""Share of the strongest drive above which a line counts as driven.

A Hann window leaks half of a line's amplitude into the next line.
"""
STILL_SCRIPT_NM_S = 1e-6
"""Largest rate of change of a planned torque that counts as constant, in N m/s."""
NO_SCRIPT_TEXT = "the scenario does not contain the hand's intention: the drive is unknown"


class FrequencyResponse(NamedTuple):
    """Ratio of two recorded signals at one frequency, such as torque over velocity.

    Both signals are caused by a known drive, such as the motion of an operator. Values that the
    log does not determine are `None`.

    Attributes:
        frequency_hz: Frequency of the spectral line, in Hz.
        gain: Magnitude of the ratio, in the unit of output over input.
        phase_rad: Phase of the ratio, in rad.
        coherence: The smaller of the coherences of input and output with the drive, from 0 to
            1.
        segments: Effective number of segments: the number of segments of equal power that would
            excite the line as much as all recorded segments do.
        error: Random error of the magnitude: one standard deviation, relative to the magnitude.
        why: The reason why the ratio could not be determined. Empty if it was determined.
    """

    frequency_hz: float | None = None
    gain: float | None = None
    phase_rad: float | None = None
    coherence: float | None = None
    segments: float | None = None
    error: float | None = None
    why: str = ""

    @classmethod
    def estimate(
        cls,
        drive: Array,
        put_in: Array,
        came_out: Array,
        usable: Bools,
        rate_hz: int,
        least: float,
    ) -> "list[FrequencyResponse]":
        """Estimates the ratio of an output to an input at every sufficiently driven frequency.

        Both signals are caused by a third one, the drive, and are compared through their
        cross-spectra with it. `scipy.signal.csd` is not used, because it cannot skip segments
        with unusable rows.

        Args:
            drive: The signal that causes both and depends on no other signal, shape (K,).
            put_in: The input signal, shape (K,).
            came_out: The output signal, shape (K,).
            usable: True for recorded rows in which no other drive is active, shape (K,).
            rate_hz: Rows per second.
            least: Smallest drive amplitude at which a frequency counts as driven.

        Returns:
            The responses, beginning with the one at the frequency with the strongest drive. If
            there is no usable segment or no sufficiently driven frequency, a single response
            that contains the reason.
        """
        length = round(SEGMENT_S * rate_hz)
        starts = _find_segments(usable, length)
        if not starts:
            reason = f"the log has no interval of {SEGMENT_S:g} s without another drive"
            return [FrequencyResponse(why=reason)]

        D = _compute_spectra(drive, starts, length)
        drive_power = (np.abs(D) ** 2).mean(axis=0)
        if not np.isfinite(drive_power).all():
            return [FrequencyResponse(why="the values of the drive are too large")]

        strongest = int(drive_power.argmax())
        if math.sqrt(2.0 * drive_power[strongest]) < least:
            return [FrequencyResponse(why="the drive is too weak at every frequency")]
        # a sinusoid of amplitude a has the mean square a^2 / 2
        least_power = max(0.5 * least**2, _DRIVEN_SHARE**2 * drive_power[strongest])
        driven_lines = np.flatnonzero(drive_power >= least_power)

        X = _compute_spectra(put_in, starts, length)
        Y = _compute_spectra(came_out, starts, length)

        responses = []
        for line in (strongest, *driven_lines[driven_lines != strongest].tolist()):
            frequency_hz = (line + _LOWEST_LINE) / SEGMENT_S
            response = _estimate_at_line(
                frequency_hz=frequency_hz,
                D=D[:, line],
                X=X[:, line],
                Y=Y[:, line],
            )
            responses.append(response)
        return responses


def _find_segments(usable: Bools, length: int) -> list[int]:
    """Divides records into segments for a spectrum, and returns their first rows.

    Welch's method averages over segments that overlap by half. A segment with an unusable row
    is left out.

    Args:
        usable: True for usable rows, shape (K,).
        length: Number of rows of a segment.
    """
    if length < 4 * _LOWEST_LINE:
        return []
    bad_rows_before = np.concatenate([[0], np.cumsum(~usable)])
    first = np.arange(0, len(usable) - length + 1, length // 2)
    # a segment is usable if the count does not rise within it
    is_usable = bad_rows_before[first + length] == bad_rows_before[first]
    starts: list[int] = first[is_usable].tolist()
    return starts


def _estimate_at_line(
    frequency_hz: float,
    D: Complex,
    X: Complex,
    Y: Complex,
) -> FrequencyResponse:
    """Estimates the ratio of two signals at one frequency, for example torque to velocity.

    The spectra of several segments are averaged, which reduces the effect of noise.

    Args:
        frequency_hz: The frequency.
        D: Spectrum of the drive in every segment, shape (S,).
        X: Spectrum of the input in every segment, shape (S,).
        Y: Spectrum of the output in every segment, shape (S,).
    """
    power = np.abs(D) ** 2
    square_of_sum = power.sum() ** 2
    sum_of_squares = (power**2).sum()
    # number of segments of equal power that would drive the line as much
    segments = float(square_of_sum / sum_of_squares) / _OVERLAP_FACTOR
    if segments < MIN_SEGMENTS:
        reason = (
            f"undecided: {segments:.1f} stretches of {SEGMENT_S:g} s drive "
            f"{frequency_hz:g} Hz, {MIN_SEGMENTS:g} are needed"
        )
        return FrequencyResponse(frequency_hz, segments=segments, why=reason)

    input_coherence = _compute_coherence(D, X)
    output_coherence = _compute_coherence(D, Y)
    coherence = min(input_coherence, output_coherence)
    if coherence < MIN_COHERENCE:
        reason = (
            f"undecided: the coherence at {frequency_hz:g} Hz is {coherence:.2f}, "
            f"{MIN_COHERENCE:g} is needed"
        )
        return FrequencyResponse(
            frequency_hz=frequency_hz,
            coherence=coherence,
            segments=segments,
            why=reason,
        )

    S_dx = np.vdot(D, X)
    S_dy = np.vdot(D, Y)
    H = S_dy / S_dx
    input_noise = 1.0 / input_coherence - 1.0
    output_noise = 1.0 / output_coherence - 1.0
    # random error of a ratio of cross spectra
    noise = max(0.0, input_noise + output_noise)
    error = math.sqrt(noise / (2.0 * segments))
    return FrequencyResponse(
        frequency_hz=frequency_hz,
        gain=float(abs(H)),
        phase_rad=float(np.angle(H)),
        coherence=coherence,
        segments=segments,
        error=error,
    )


def _compute_coherence(D: Complex, X: Complex) -> float:
    """Returns the coherence |S_dx|^2 / (S_dd S_xx) of two signals, from 0 to 1.

    A value near 1 means that one signal explains the other. Measurements with a low coherence
    are not reliable. The coherence is 0 if one of the signals vanishes.
    """
    S_dd = np.vdot(D, D).real
    S_xx = np.vdot(X, X).real
    S_dx = np.vdot(D, X)
    power = float(S_dd * S_xx)
    if not power > 0.0:
        return 0.0
    common_power = float(abs(S_dx) ** 2)
    return min(1.0, common_power / power)


def _compute_spectra(signal: Array, starts: list[int], length: int) -> Complex:
    """Returns the spectrum of every segment under a Hann window, shape (S, L).

    The lines are scaled so that the square of a line is the mean square of its sinusoid. No
    trend is removed, because this would distort slow sinusoids too.

    Args:
        signal: The signal, shape (K,).
        starts: First row of every segment.
        length: Number of rows of a segment.
    """
    segments = np.stack([signal[start : start + length] for start in starts])
    middles = np.arange(length) + 0.5
    angles = 2.0 * np.pi * middles / length
    window = 0.5 - 0.5 * np.cos(angles)
    highest = min(int(HIGHEST_HZ * SEGMENT_S), length // 2 - 1)
    scale = math.sqrt(2.0) / window.sum()
    spectra = np.fft.rfft(segments * window, axis=1)
    lines: Complex = spectra[:, _LOWEST_LINE : highest + 1] * scale
    return lines


class ImpedanceEstimate(NamedTuple):
    """Measured impedance or force reflection at one joint of an arm, over frequency.

    The impedance describes how heavy, damped and stiff the arm feels to its operator. The
    reflection describes how much of a distant force the operator feels.

    Attributes:
        kind: "impedance" or "reflection". An impedance is the operator's torque divided by the
            joint velocity, in N m s/rad. It includes the effect of all coupled arms. A
            reflection is the torque that an operator feels, divided by the torque of the
            environment on another arm.
        at: Site of the operator.
        of: Site of the environment, for a reflection. Empty for an impedance.
        joint: Number of the joint, from 1.
        ratio: The complex ratio at the frequency with the strongest drive.
        spectrum: The ratios at all frequencies that are sufficiently driven, in ascending order
            of frequency.
    """

    kind: str
    at: str
    of: str
    joint: int
    ratio: FrequencyResponse
    spectrum: tuple[FrequencyResponse, ...] = ()

    @property
    def unit(self) -> str:
        """Unit of the ratio: "N m s/rad" for an impedance (torque per velocity).

        Empty for a reflection, which is a ratio of two torques.
        """
        return "" if self.kind == "reflection" else "N m s/rad"

    @classmethod
    def list_of_run(cls, view: RunView) -> "list[ImpedanceEstimate]":
        """Estimates what each operator feels, over frequency, from a recorded run.

        For each operator, the impedance is estimated: the operator's torque over the joint
        velocity. For each environment at another arm, the reflection is estimated: the torque
        that the operator feels over the torque of the environment.

        Args:
            view: The run.
        """
        runs = view.shared
        operators = [site for site, run in runs.items() if run.torque.operator.any()]
        environments = [site for site, run in runs.items() if run.torque.environment.any()]
        estimates: list[ImpedanceEstimate] = []
        for site in operators:
            estimates += _estimate_joints(runs, site, "")
        for environment in environments:
            for site in operators:
                if site != environment:
                    estimates += _estimate_joints(runs, site, environment)
        return estimates


def _estimate_joints(
    runs: Mapping[str, SiteRun],
    site: str,
    environment: str,
) -> Iterator[ImpedanceEstimate]:
    """Yields what an operator feels at each joint of an arm, as a function of frequency.

    This is the impedance of the arm, or the reflection of the environment at another arm.

    Args:
        runs: All sites with records.
        site: Site of the operator.
        environment: Site of the environment. Empty for an impedance.
    """
    records = runs[site].records
    torque = runs[site].torque
    is_usable = _find_still_rows(runs, site, alone=not environment)
    rows, is_recorded = runs[environment or site].records.find_latest_rows(records.t_s)

    for joint in range(records.qd.shape[1]):
        responses = [FrequencyResponse(why=NO_SCRIPT_TEXT)]
        if torque.script is not None and is_usable is not None:
            is_usable = is_usable & records.known
            operator = torque.operator[:, joint]
            if environment:
                wall_torque = runs[environment].torque.environment[rows, joint]
                responses = FrequencyResponse.estimate(
                    drive=wall_torque,
                    put_in=wall_torque,
                    came_out=-operator,
                    usable=is_usable & is_recorded,
                    rate_hz=records.rate_hz,
                    least=MIN_DRIVE_TORQUE_NM,
                )
            else:
                responses = FrequencyResponse.estimate(
                    drive=torque.script[:, joint],
                    put_in=records.qd[:, joint],
                    came_out=operator,
                    usable=is_usable,
                    rate_hz=records.rate_hz,
                    least=MIN_DRIVE_TORQUE_NM,
                )

        spectrum = [response for response in responses if response.frequency_hz]
        spectrum.sort(key=lambda response: response.frequency_hz or 0.0)
        yield ImpedanceEstimate(
            kind="reflection" if environment else "impedance",
            at=site,
            of=environment,
            joint=joint + 1,
            ratio=responses[0],
            spectrum=tuple(spectrum),
        )


def _find_still_rows(
    runs: Mapping[str, SiteRun],
    reference_site: str,
    *,
    alone: bool,
) -> Bools | None:
    """Finds the ticks (control periods) at which no operator makes a planned motion.

    Impedance is measured only at these ticks, because other operators would disturb the
    measurement.

    Args:
        runs: All sites with records.
        reference_site: The site whose ticks are judged.
        alone: True if the operator of that site may move, because it is the drive itself.

    Returns:
        True for each such tick, shape (K,). `None` if the plan of some operator is unknown.
    """
    t_s = runs[reference_site].records.t_s
    is_still = np.ones(len(t_s), dtype=np.bool_)
    for site, run in runs.items():
        if alone and site == reference_site:
            continue
        plan = run.torque.script
        if plan is None:
            return None
        if len(plan) > 1:
            rows, _ = run.records.find_latest_rows(t_s)
            changes_nm = np.abs(np.gradient(plan, axis=0))
            rate_nm_s = changes_nm.max(axis=1) * run.records.rate_hz
            is_still &= rate_nm_s[rows] < STILL_SCRIPT_NM_S
    return is_still
