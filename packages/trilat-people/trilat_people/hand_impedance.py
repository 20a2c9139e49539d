"""Identifies the mass, damping and stiffness of a person's hand from the log of a run.

While the person holds an arm, a simulated operator of the kind `multisine` excites the arms
with a sum of sines. At the angular frequency w of each sine, the force F of the hand on the arm
and the position X of the end effector satisfy

    F(j w) = -(M (j w)^2 + B j w + K) X(j w)

where M, B and K are the mass, damping and stiffness matrices of the hand, with one row and
column per spatial axis. Voluntary movements of the person are not synchronised with the sines,
so their contribution averages out over segments of the run. In the terms of system
identification, the sines are an instrument. M, B and K are fitted by weighted least squares.
Their confidence intervals are computed with the jackknife, which repeats the fit omitting one
segment at a time.

Sources:
    - Stiffness along several axes: E. J. Perreault, R. F. Kirsch, A. M. Acosta,
      "Multiple-input, multiple-output system identification for characterization of limb
      stiffness dynamics", Biological Cybernetics 80 (1999).
    - Sines in a closed loop: R. Pintelon, J. Schoukens, "System identification: a frequency
      domain approach" (2012), ch. 2 and 7.
    - Confidence intervals: B. Efron, "The jackknife, the bootstrap and other resampling plans"
      (1982).

Invariant:
    - F is the force with which the hand pushes the arm, in N. It excludes the force of sines
      that act on the same arm.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import stdtrit

from trilat_net.analysis import AlignedRecords, Complex, SourceRows, TorqueSplit
from trilat_net.core import SCRIPTED_KINDS, Array, TorqueKind, TorqueSource
from trilat_net.errors import UsageError, count_nouns
from trilat_net.log import Log, open_log
from trilat_net.presentation import Block, TextTable
from trilat_net.results import Result
from trilat_net.scenario import Scenario

MIN_SEGMENTS = 5
"""Minimum number of segments for computing confidence intervals."""
MIN_KNOWN_SHARE = 0.98
"""Minimum fraction of a segment's records that must be in the log."""
NEIGHBOUR_CORRELATION = 1.0 / 6.0
"""Correlation of white noise in two Hann-windowed segments that overlap by half."""
MAX_CONDITION = 1e3
"""Largest condition number of the motions at which the axes can be distinguished."""
_TINY = 1e-300
"""Smallest divisor, which makes 0 / 0 evaluate to 0."""
UNITS = {"M": "kg", "B": "N s/m", "K": "N/m"}
"""Mapping from each matrix to its unit."""


class _SineResponse(NamedTuple):
    """Response of the hand and the arm to one of the excitation sines.

    To identify the hand that holds an arm, the arm is excited with small forces at several
    frequencies. The run is divided into segments, whose spectra are compared.

    Attributes:
        hz: Frequency, in Hz.
        motion_mm: Amplitude of the motion over all axes, in mm.
        force_n: Amplitude of the force over all axes, in N.
        coherence: Fraction of the motion or of the force, whichever is smaller, that is
            repeatable between segments; 1 if all segments are equal.
        unexplained: Fraction of the force not explained by M, B and K.
    """

    hz: float
    motion_mm: float
    force_n: float
    coherence: float
    unexplained: float


@dataclass(frozen=True, repr=False)
class HandImpedance(Result):
    """Identified mass, damping and stiffness of a hand that holds an arm.

    The model of the hand is force = M acceleration + B velocity + K displacement. Each matrix
    entry is the force along the axis of its row per unit of motion along the axis of its
    column.

    Attributes:
        site: Name of the site whose arm the hand holds.
        M: Mass, force per acceleration, in kg, shape (n, n).
        B: Damping, force per velocity, in N s/m, shape (n, n).
        K: Stiffness, force per displacement, in N/m, shape (n, n).
        halves: Half-widths of the 95 % confidence intervals of "M", "B" and "K", each of shape
            (n, n).
        segments: Number of segments of the run.
        segment_s: Duration of a segment, in s.
        responses: Responses of the hand at the excitation frequencies, in ascending order.
    """

    site: str
    M: Array
    B: Array
    K: Array
    halves: dict[str, Array]
    segments: int
    segment_s: float
    responses: tuple[_SineResponse, ...]

    def to_dict(self) -> dict[str, Any]:
        """Converts the result to plain values, as read by `trilat linear --operators`.

        Contains the mass, damping and stiffness matrices, their confidence intervals and the
        measured responses.
        """
        return {
            "site": self.site,
            "segments": self.segments,
            "segment_s": self.segment_s,
            "mass_kg": self.M.tolist(),
            "damping_n_s_m": self.B.tolist(),
            "stiffness_n_m": self.K.tolist(),
            "mass_kg_half": self.halves["M"].tolist(),
            "damping_n_s_m_half": self.halves["B"].tolist(),
            "stiffness_n_m_half": self.halves["K"].tolist(),
            "hand": self.to_hand(),
            "sines": self.to_rows(),
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns the measured responses of the hand as a table, with one row per frequency.

        Each row contains the amplitudes of motion and force, their coherence, and the part of
        the force that is not explained by mass, damping and stiffness.
        """
        return [response._asdict() for response in self.responses]

    def to_hand(self) -> dict[str, Any]:
        """Returns the scenario settings of the simulated operator most similar to this hand.

        The operator is a spring and a damper along each axis, with no mass.
        """
        return {
            "kind": "tip_spring",
            "stiffness_n_m": _round_diagonal(self.K),
            "damping_n_s_m": _round_diagonal(self.B),
        }

    def blocks(self) -> Iterator[Block]:
        """Yields the parts of the report that `trilat identify hand` prints.

        These are the mass, damping and stiffness matrices with their confidence intervals, a
        table of motion and force at each excitation frequency, and the settings of the most
        similar simulated operator.
        """
        segments = count_nouns(self.segments, "segment")
        yield f"hand at {self.site}: {segments} of {self.segment_s:g} s, intervals of 95 %"
        yield self._tabulate_matrices()
        sine_rows = [_format_response(response) for response in self.responses]
        headers = ("sine", "motion", "force", "coherence", "unexplained")
        units = ("Hz", "mm", "N")
        yield TextTable(headers, sine_rows, "r", units)

        setting_texts: list[str] = []
        for key, value in self.to_hand().items():
            value_text = json.dumps(value)
            setting_texts.append(f"{key} = {value_text}")
        table_text = ", ".join(setting_texts)
        yield f"in a scenario, without the mass of the hand: hands = [{{ {table_text} }}]"

    def _tabulate_matrices(self) -> TextTable:
        """Returns a table of the identified mass M, damping B and stiffness K.

        Has one row per matrix, and one column per entry, named by its axes, as in "xy". Each
        cell contains the value and the half-width of its confidence interval.
        """
        axes = "xyz"[: len(self.K)]
        entries = list(product(range(len(axes)), repeat=2))
        headers = [axes[row] + axes[column] for row, column in entries]
        rows: list[tuple[str, ...]] = []
        for letter, unit in UNITS.items():
            matrix = getattr(self, letter)
            half_widths = self.halves[letter]
            cells = [f"{letter}, {unit}"]
            for entry in entries:
                value = matrix[entry]
                half_width = half_widths[entry]
                cells.append(f"{value:.4g} +- {half_width:.2g}")
            rows.append(tuple(cells))
        return TextTable(("", *headers), rows, align="lr")


def _format_response(response: _SineResponse) -> tuple[str, ...]:
    """Formats the response to one sine as table cells with three digits."""
    return tuple(f"{value:.3g}" for value in response)


def _round_diagonal(matrix: Array) -> list[float]:
    """Returns the diagonal of a matrix, rounded to four digits, for use in a scenario.

    Mass, damping and stiffness are not negative, so a negative entry is a measurement error and
    is replaced with 0.

    Args:
        matrix: Identified mass, damping or stiffness, shape (D, D).
    """
    rounded: list[float] = []
    for value in np.diag(matrix):
        four_digits = float(f"{value:.4g}")
        rounded.append(max(0.0, four_digits))
    return rounded


def identify_hand(log: Log | str | Path, site: str = "m1") -> HandImpedance:
    """Identifies the mass, damping and stiffness of the hand that holds an arm.

    While the person holds the arm, a simulated operator of the kind `multisine` must excite the
    arms with a sum of sines. Equivalent to the command `trilat identify hand`.

    >>> hand = tn.identify_hand("run.mcap", "m1")  # doctest: +SKIP
    >>> hand.K.diagonal(), hand.halves["K"].diagonal()  # doctest: +SKIP

    Args:
        log: Log of the run, or path of the log.
        site: Name of the site whose arm the hand holds.

    Returns:
        The matrices M, B and K, and in `halves` the half-widths of their 95 % confidence
        intervals.

    Raises:
        UsageError: The run has no such site, contains no excitation by sines or is too short,
            or the end effector did not move along enough axes or at enough frequencies.
    """
    if not isinstance(log, Log):
        log = open_log(log)
    scenario = log.scenario
    scenario.find_site(site)
    sines = _find_sines(scenario)
    records = AlignedRecords.by_site(log)[site]
    force, position = _compute_hand_force(records, scenario)

    # A segment lasts two periods of the smallest spacing between frequencies (or of the lowest
    # frequency), so that the window separates the sines.
    frequencies_hz = np.concatenate([[0.0], sines.hz])
    smallest_spacing_hz = np.diff(frequencies_hz).min()
    segment_s = float(np.round(2.0 / smallest_spacing_hz, 9))
    is_before_end = records.t_s < sines.end_s
    signals = np.hstack((force, position))[is_before_end]
    phasors = _compute_phasors(
        records=records,
        signals=signals,
        hz=sines.hz,
        start_s=sines.start_s,
        segment_s=segment_s,
    )
    if len(phasors) < MIN_SEGMENTS:
        segments = count_nouns(len(phasors), "whole segment")
        needed_segments = 0.5 * MIN_SEGMENTS + 1.0
        needed_s = sines.start_s + needed_segments * segment_s
        raise UsageError(
            f"{site}: the log has {segments} of {segment_s:g} s in which the sines act, but "
            f"the confidence intervals need {MIN_SEGMENTS}: record a run of at least "
            f"{needed_s:g} s"
        )

    axis_count = force.shape[1]
    F, X = np.split(np.array(phasors), [axis_count], axis=2)
    rates_rad_s = 2.0 * np.pi * sines.hz
    fit = _fit_with_intervals(site, F, X, rates_rad_s)
    M, B, K = fit.matrices
    halves = dict(zip(UNITS, fit.halves, strict=True))
    return HandImpedance(
        site=site,
        M=M,
        B=B,
        K=K,
        halves=halves,
        segments=len(phasors),
        segment_s=segment_s,
        responses=_list_responses(F, X, sines.hz, fit.unexplained),
    )


def _list_responses(
    F: Complex, X: Complex, hz: Array, unexplained: Array
) -> tuple[_SineResponse, ...]:
    """Computes the response of hand and arm at each frequency, averaged over segments.

    The responses show how informative each frequency is. They contain the amplitudes, their
    repeatability (coherence), and the fraction of the force not explained by the fit.

    Args:
        F: Phasors (complex amplitudes) of the force, in N, shape (segments, F, n).
        X: Phasors of the position, in m, shape (segments, F, n).
        hz: The F frequencies, in Hz.
        unexplained: Fraction of the force not explained by the fit, shape (F,).
    """
    force_coherence = _compute_coherence(F)
    motion_coherence = _compute_coherence(X)
    coherence = np.minimum(force_coherence, motion_coherence)

    mean_motion = X.mean(axis=0)
    motion_mm = 1e3 * np.linalg.norm(mean_motion, axis=1)
    mean_force = F.mean(axis=0)
    force_n = np.linalg.norm(mean_force, axis=1)

    responses: list[_SineResponse] = []
    for index, frequency_hz in enumerate(hz):
        response = _SineResponse(
            hz=float(frequency_hz),
            motion_mm=float(motion_mm[index]),
            force_n=float(force_n[index]),
            coherence=float(coherence[index]),
            unexplained=float(unexplained[index]),
        )
        responses.append(response)
    return tuple(responses)


class _Sines(NamedTuple):
    """Sinusoidal excitation of an arm, used to identify a person's hand.

    Attributes:
        hz: Frequencies of all sines in ascending order, in Hz.
        start_s: Time at which all sines have started, in s.
        end_s: Time at which the first sine ends, in s.
    """

    hz: Array
    start_s: float
    end_s: float


def _find_sines(scenario: Scenario) -> _Sines:
    """Returns the sines with which simulated operators excite the arms, at any site.

    Raises:
        UsageError: No operator of the scenario is of the kind `multisine`. The error explains
            why the hand cannot be identified without one.
    """
    multisines: list[TorqueSource] = []
    for site_settings in scenario.sites.values():
        sources = [hand.actor for hand in site_settings.hands]
        multisines += [source for source in sources if source.kind is TorqueKind.MULTISINE]
    if not multisines:
        raise UsageError(
            "no operator of kind 'multisine' in the scenario moves an arm, so the "
            "reaction of a hand cannot be distinguished from its own movements "
            "(docs/studies/measured-hands.md)"
        )

    frequencies_hz: list[float] = []
    for multisine in multisines:
        assert multisine.table is not None
        frequencies_hz += multisine.table[:, 0].tolist()
    return _Sines(
        hz=np.unique(frequencies_hz),
        start_s=max(multisine.start_s for multisine in multisines),
        end_s=min(multisine.end_s for multisine in multisines),
    )


def _compute_hand_force(records: AlignedRecords, scenario: Scenario) -> tuple[Array, Array]:
    """Returns the force of the hand ON the end effector, and the end effector position.

    The recorded operator torque includes both the hand and the simulated operators of the same
    arm. The torques of scripted operators, such as sines, are subtracted from it.

    Args:
        records: Records of the arm.
        scenario: Scenario of the run.

    Returns:
        The force in N and the position in m, each of shape (K, n) for K records.
    """
    split = TorqueSplit.of_records(records, scenario)
    end_effector = split.end_effector
    scripted_torque = np.zeros_like(records.q)
    for hand in scenario.sites[records.site].hands:
        operator = hand.actor
        if operator.kind in SCRIPTED_KINDS:
            script = SourceRows(operator).compute_script(records.nominal_s, end_effector.J[0])
            scripted_torque += script

    hand_torque = split.operator - scripted_torque
    force = end_effector.find_force(hand_torque)
    return force, end_effector.position


def _compute_phasors(
    records: AlignedRecords, signals: Array, hz: Array, start_s: float, segment_s: float
) -> list[Complex]:
    """Computes the phasors of signals at the frequencies of the sines, segment by segment.

    A phasor is the complex amplitude of a signal at one frequency. Segments overlap by half and
    are weighted with a Hann window. The spectrum of the window is zero at the other sines,
    which are at least two multiples of 1 / segment_s away. It falls with the third power of the
    frequency, so transients and drift, which are slower than the sines, hardly contribute. The
    first half-segment is discarded, and segments with too many missing records are skipped.

    Args:
        records: Records of the site.
        signals: Signals, shape (K, signals).
        hz: The F frequencies, in Hz.
        start_s: Time at which all sines have started, in s.
        segment_s: Duration of a segment, in s.

    Returns:
        One array of phasors per segment, shape (F, signals).
    """
    segment_size = round(segment_s * records.rate_hz)
    half_s = 0.5 * segment_s
    first_tick = round((start_s + half_s) * records.rate_hz)
    first_row = max(first_tick - records.first, 0)
    end_row = len(signals) - segment_size + 1
    row_step = segment_size // 2

    # Hann window.
    window_phase = 2.0 * np.pi * np.arange(segment_size) / segment_size
    window = 0.5 - 0.5 * np.cos(window_phase)
    window_sum = window.sum()

    phasors: list[Complex] = []
    for start in range(first_row, end_row, row_step):
        segment_rows = slice(start, start + segment_size)
        known_share = records.known[segment_rows].mean()
        if known_share < MIN_KNOWN_SHARE:
            continue

        segment = signals[segment_rows]
        cycles = np.outer(hz, records.t_s[segment_rows])
        carriers = np.exp(-2j * np.pi * cycles)
        mean = window @ segment / window_sum
        deviation = segment - mean
        phasors.append(2.0 / window_sum * (carriers * window) @ deviation)
    return phasors


def _compute_coherence(phasors: Complex) -> Array:
    """Computes the coherence of phasors over segments and all axes, shape (F,).

    The coherence is |mean of z|^2 / mean of |z|^2, where z is the phasor of a segment and the
    means are over segments. It is 1 if all segments are equal, and close to 0 for random
    phasors.

    Args:
        phasors: The phasors, shape (segments, F, n).
    """
    squared_amplitudes = np.abs(phasors) ** 2
    power = squared_amplitudes.mean(axis=0).sum(axis=1)
    mean_phasors = phasors.mean(axis=0)
    squares_of_mean = np.abs(mean_phasors) ** 2
    power_of_mean = squares_of_mean.sum(axis=1)
    coherence: Array = power_of_mean / np.maximum(power, _TINY)
    return coherence


class _HandFit(NamedTuple):
    """Mass, damping and stiffness of a hand, fitted to measured forces and motions.

    The matrices M, B and K are the best fit to force = M acceleration + B velocity + K
    displacement. Shapes are for n axes and F frequencies.

    Attributes:
        matrices: M, B and K, shape (3, n, n).
        halves: Half-widths of their 95 % confidence intervals, shape (3, n, n).
        unexplained: Fraction of the force not explained by the fit, shape (F,).
    """

    matrices: Array
    halves: Array
    unexplained: Array


def _fit_with_intervals(site: str, F: Complex, X: Complex, w: Array) -> _HandFit:
    """Fits M, B and K to phasors and estimates their confidence intervals with the jackknife.

    Args:
        site: Name of the site, for the error message.
        F: Phasors of the force, in N, shape (segments, F, n).
        X: Phasors of the position, in m, shape (segments, F, n).
        w: Angular frequencies, in rad/s, shape (F,).

    Raises:
        UsageError: The motions do not allow the axes, or mass, damping and stiffness, to be
            distinguished.
    """
    segment_count, _, axis_count = X.shape
    # Each derivative multiplies a phasor by j w.
    s = 1j * w[:, np.newaxis]
    acceleration = s**2 * X
    velocity = s * X
    motions = -np.concatenate((acceleration, velocity, X), axis=2)
    if not _can_distinguish(motions):
        axes_text = count_nouns(axis_count, "axis")
        raise UsageError(
            f"{site}: the end effector moved along fewer than {axes_text}, "
            "or at too few frequencies to distinguish mass, damping and stiffness: "
            "let sines of other frequencies act on another joint"
        )

    all_segments = np.arange(segment_count)
    forces = F.transpose(2, 0, 1)
    estimate = _fit_all_axes(forces, motions, all_segments)

    # The jackknife leaves out one segment at a time.
    partial_estimates: list[Array] = []
    for segment in range(segment_count):
        other_segments = all_segments[all_segments != segment]
        partial_estimates.append(_fit_all_axes(forces, motions, other_segments))

    freedom = segment_count - 1
    pseudo_values = segment_count * estimate - freedom * np.array(partial_estimates)
    # Neighbouring segments overlap and are correlated, which widens the interval.
    inflation = 1.0 + 2.0 * NEIGHBOUR_CORRELATION * freedom / segment_count
    deviation = pseudo_values.std(axis=0, ddof=1)
    student_quantile = stdtrit(freedom, 0.975)
    halves = student_quantile * deviation * np.sqrt(inflation / segment_count)

    mean_force = F.mean(axis=0)
    fitted_force = motions.mean(axis=0) @ estimate.T
    force_error = mean_force - fitted_force
    residual = np.linalg.norm(force_error, axis=1)
    force_size = np.linalg.norm(mean_force, axis=1)
    # The rows of M, B and K for an axis follow each other in the estimate.
    matrix_rows = estimate.reshape(axis_count, 3, axis_count)
    half_rows = halves.reshape(axis_count, 3, axis_count)
    return _HandFit(
        matrices=matrix_rows.transpose(1, 0, 2),
        halves=half_rows.transpose(1, 0, 2),
        unexplained=residual / np.maximum(force_size, _TINY),
    )


def _fit_all_axes(forces: Complex, motions: Complex, segments: NDArray[np.int64]) -> Array:
    """Fits the mass M, damping B and stiffness K of a hand to its motion, axis by axis.

    For n axes, the result contains the rows of all three matrices, shape (n, 3 n) (see
    `_fit_impedance`).

    Args:
        forces: Phasors of the force along each axis, shape (n, segments, F).
        motions: Phasors of -(acceleration, velocity, position), shape (segments, F, 3 n).
        segments: Indices of the segments to average.
    """
    impedances = [_fit_impedance(force, motions, segments) for force in forces]
    return np.array(impedances)


def _can_distinguish(motions: Complex) -> bool:
    """Returns True if the motions determine mass, damping and stiffness along all axes.

    Otherwise, the result of the fit would be arbitrary. There must be enough frequencies, and
    the motions along the axes and their derivatives must be linearly independent, with a
    condition number of at most `MAX_CONDITION`.

    Args:
        motions: Phasors of -(acceleration, velocity, position), shape (segments, F, 3 n).
    """
    mean_motion = motions.mean(axis=0)
    design = _stack_real_and_imaginary(mean_motion)
    column_sizes = np.linalg.norm(design, axis=0)
    normalised = design / np.maximum(column_sizes, _TINY)
    singular_values = np.linalg.svd(normalised, compute_uv=False)
    largest_singular = singular_values[0]
    smallest_singular = singular_values[-1]
    is_singular = smallest_singular * MAX_CONDITION < largest_singular

    equation_count, unknown_count = design.shape
    return equation_count >= unknown_count and not is_singular


def _stack_real_and_imaginary(phasors: Complex) -> Array:
    """Concatenates the real parts of complex numbers and their imaginary parts.

    This converts K complex equations to 2 K real equations with real unknowns.

    Args:
        phasors: Array of shape (K, ...).
    """
    return np.concatenate((phasors.real, phasors.imag))


def _fit_impedance(force: Complex, motions: Complex, segments: NDArray[np.int64]) -> Array:
    """Estimates the mass, damping and stiffness of a hand for the force along one axis.

    The model is force = motions @ impedance, solved by weighted least squares. At each
    frequency, the mean residual over the segments is divided by the standard deviation of the
    residuals, so noisy frequencies have less weight. Since the person's own movements also add
    noise to the measured motion, the standard deviation depends on the impedance. The problem
    is therefore nonlinear, and its initial guess is computed by ordinary least squares.

    Args:
        force: Phasors of the force along the axis, shape (segments, F).
        motions: Phasors of -(acceleration, velocity, position), shape (segments, F, 3 n).
        segments: Indices of the segments to average.

    Returns:
        The rows of M, B and K for this axis, shape (3 n,).
    """
    mean_motion = motions[segments].mean(axis=0)  # shape (F, 3 n)
    mean_force = force[segments].mean(axis=0)  # in N, shape (F,)
    smallest_deviation = 1e-6 * np.abs(mean_force).max()  # avoids a division by zero

    def compute_weighted_residuals(impedance: Array) -> Array:
        """Returns the weighted difference between the measured force and the model's force.

        At each frequency, the difference is averaged over the segments of the run and divided
        by its standard deviation over the segments. Forces, motions and their means are taken
        from the enclosing function.

        Args:
            impedance: Rows of the mass M, damping B and stiffness K for the axis of the force,
                concatenated, shape (3 n,), where n is the number of axes of the motion.

        Returns:
            Dimensionless real parts, followed by the imaginary parts, shape (2 F,) for F
            frequencies.
        """
        residuals = force - motions @ impedance  # in N, shape (segments, F)
        deviation_over_segments = residuals.std(axis=0)
        deviation = np.maximum(deviation_over_segments, smallest_deviation)
        mean_residual = mean_force - mean_motion @ impedance  # in N, shape (F,)
        return _stack_real_and_imaginary(mean_residual / deviation)

    design = _stack_real_and_imaginary(mean_motion)
    values = _stack_real_and_imaginary(mean_force)
    first_guess = np.linalg.lstsq(design, values, rcond=None)[0]
    fit = least_squares(compute_weighted_residuals, first_guess, x_scale="jac")
    impedance: Array = fit.x
    return impedance
