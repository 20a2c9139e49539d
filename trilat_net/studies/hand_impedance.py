"""Mass, damping and stiffness of the hand at an arm that sines move, from a log.

Somebody holds the arm of a site while an operator of kind `multisine`, at any site, moves it.
The force of the hand and the position follow the sines; the person's own movements do not. At
the frequencies of the sines

    F(j w) = -(M (j w)^2 + B j w + K) X(j w)

so that means over segments of a run give the same M, B and K whatever else happens, as with an
instrument in the sense of system identification. Confidence intervals come from the jackknife
over segments.

Sources:
    - Stiffness along both axes at once: E. J. Perreault, R. F. Kirsch, A. M. Acosta,
      "Multiple-input, multiple-output system identification for characterization of limb
      stiffness dynamics", Biological Cybernetics 80 (1999).
    - Sines in a closed loop: R. Pintelon, J. Schoukens, "System identification: a frequency
      domain approach" (2012), ch. 2 and 7.
    - B. Efron, "The jackknife, the bootstrap and other resampling plans" (1982).

Invariant:
    - Force is that of the hand ON the arm, N, without the sines if they act at the same site.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import stdtrit

from ..analysis.aligned import AlignedRecords, align_records
from ..analysis.torque_sources import compute_operator_script, split_torque
from ..core.exogenous import SCRIPTED_KINDS
from ..core.vectors import Array
from ..errors import UsageError, count_nouns
from ..log.log_reader import Log, open_log
from ..reporting.result_text import Block, TextTable
from ..results import Result
from ..scenario import Scenario, find_site
from ..scenario.operators.kernel_operators import Multisine
from ..theory.characteristic_roots import Complex
from ..theory.port_passivity import HandMatrices

LEAST_SEGMENTS = 5
"""Number of segments that an interval needs."""
LEAST_KNOWN = 0.98
"""Share of its records that a segment needs."""
NEIGHBOURS = 1.0 / 6.0
"""Correlation of white noise in two segments with Hann's window that overlap by half."""
FARTHEST_CONDITION = 1e3
"""Largest condition number of the motions, so that the axes can be distinguished."""
KEYS = {"mass_kg": "M", "damping_n_s_m": "B", "stiffness_n_m": "K"}
"""The matrix of each key in JSON."""
UNITS = {"M": "kg", "B": "N s/m", "K": "N/m"}


class SineResponse(NamedTuple):
    """The response at one frequency.

    Attributes:
        hz: the frequency, Hz.
        motion_mm: amplitude of the motion over all axes, mm.
        force_n: amplitude of the force over all axes, N.
        coherence: coherence of motion and of force with the sines, the smaller of the two; 1 if
            all segments are equal.
        unexplained: share of the force that M, B and K do not explain.
    """

    hz: float
    motion_mm: float
    force_n: float
    coherence: float
    unexplained: float


@dataclass(frozen=True, repr=False)
class HandImpedance(Result):
    """The identified hand.

    Attributes:
        site: site of the held arm.
        M, B, K: mass, kg, damping, N s/m, and stiffness, N/m: force along the row's axis by
            motion along the column's, shape (n, n).
        halves: half the width of the 95 % intervals of "M", "B" and "K", shape (n, n).
        segments: number of segments.
        segment_s: duration of a segment, s.
        responses: the responses by rising frequency.
    """

    site: str
    M: Array
    B: Array
    K: Array
    halves: dict[str, Array]
    segments: int
    segment_s: float
    responses: tuple[SineResponse, ...]

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, which `trilat linear --operators` reads."""
        matrices = {name: getattr(self, letter).tolist() for name, letter in KEYS.items()}
        halves = {f"{name}_half": self.halves[letter].tolist() for name, letter in KEYS.items()}
        return {
            "site": self.site,
            "segments": self.segments,
            "segment_s": self.segment_s,
            **matrices,
            **halves,
            "hand": self.to_hand(),
            "sines": self.to_rows(),
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row for each frequency."""
        return [response._asdict() for response in self.responses]

    def to_hand(self) -> dict[str, Any]:
        """Returns the nearest operator of a scenario, `[[sites.m1.hands]]`, without mass."""

        def round_diagonal(matrix: Array) -> list[float]:
            return [max(0.0, float(f"{value:.4g}")) for value in np.diag(matrix)]

        return {
            "kind": "tip_spring",
            "stiffness_n_m": round_diagonal(self.K),
            "damping_n_s_m": round_diagonal(self.B),
        }

    def blocks(self) -> Iterator[Block]:
        """Yields the matrices with their intervals, the responses, and the nearest operator."""
        yield (
            f"hand at {self.site}: {count_nouns(self.segments, 'segment')} of "
            f"{self.segment_s:g} s, intervals of 95 %"
        )
        axes = "xyz"[: len(self.K)]
        entries = list(product(range(len(axes)), repeat=2))
        rows = []
        for letter, unit in UNITS.items():
            matrix = getattr(self, letter)
            half = self.halves[letter]
            cells = [f"{matrix[entry]:.4g} +- {half[entry]:.2g}" for entry in entries]
            rows.append((f"{letter}, {unit}", *cells))
        yield TextTable(("", *(axes[i] + axes[j] for i, j in entries)), rows, align="lr")
        sines = [tuple(f"{x:.3g}" for x in response) for response in self.responses]
        yield TextTable(
            ("sine", "motion", "force", "coherence", "unexplained"),
            sines,
            "r",
            ("Hz", "mm", "N"),
        )
        hand = ", ".join(
            f"{key} = {json.dumps(value)}" for key, value in self.to_hand().items()
        )
        yield f"in a scenario, without its mass: hands = [{{ {hand} }}]"


def identify_hand(log: Log | str | Path, site: str = "m1") -> HandImpedance:
    """Returns mass, damping and stiffness of the hand at an arm.

    The command is `trilat identify hand`.

    >>> hand = tn.identify_hand("run.mcap", "m1")  # doctest: +SKIP
    >>> hand.K.diagonal(), hand.halves["K"].diagonal()  # doctest: +SKIP

    Raises:
        UsageError: there is no such site or no sine, the run is too short, or the motion has
            fewer axes than the arm.
    """
    log = log if isinstance(log, Log) else open_log(log)
    scenario = log.scenario
    find_site(scenario, site)
    sines = _find_sines(scenario)
    records = align_records(log)[site]
    force, position = _compute_hand_force(records, scenario)
    spacing_hz = np.diff(np.concatenate([[0.0], sines.hz]))
    # two periods of the smallest spacing, so that the window separates the sines
    segment_s = float(np.round(2.0 / spacing_hz.min(), 9))
    columns = np.hstack((force, position))[records.t_s < sines.end_s]
    phasors = _compute_phasors(
        records=records,
        columns=columns,
        hz=sines.hz,
        start_s=sines.start_s,
        segment_s=segment_s,
    )
    if len(phasors) < LEAST_SEGMENTS:
        needed_s = sines.start_s + (0.5 * LEAST_SEGMENTS + 1.0) * segment_s
        raise UsageError(
            f"{site}: {count_nouns(len(phasors), 'whole segment')} of {segment_s:g} s while "
            f"the sines act, and intervals need {LEAST_SEGMENTS}: "
            f"a run of at least {needed_s:g} s"
        )
    F, X = np.split(np.array(phasors), [force.shape[1]], axis=2)
    fit = _fit_with_intervals(site, F, X, 2.0 * np.pi * sines.hz)
    coherence = np.minimum(_compute_coherence(F), _compute_coherence(X))
    motion_mm = 1e3 * np.linalg.norm(X.mean(axis=0), axis=1)
    force_n = np.linalg.norm(F.mean(axis=0), axis=1)
    rows = zip(sines.hz, motion_mm, force_n, coherence, fit.unexplained, strict=True)
    M, B, K = fit.matrices
    return HandImpedance(
        site=site,
        M=M,
        B=B,
        K=K,
        halves=dict(zip(UNITS, fit.halves, strict=True)),
        segments=len(phasors),
        segment_s=segment_s,
        responses=tuple(SineResponse(*map(float, row)) for row in rows),
    )


class _Sines(NamedTuple):
    """The sines of a scenario.

    Attributes:
        hz: all frequencies, rising, Hz.
        start_s: time from which all sines act, s.
        end_s: time until which all sines act, s.
    """

    hz: Array
    start_s: float
    end_s: float


def _find_sines(scenario: Scenario) -> _Sines:
    """Returns the sines of a scenario, or raises UsageError if there are none."""
    hands = [hand for spec in scenario.sites.values() for hand in spec.hands]
    multisines = [hand for hand in hands if isinstance(hand, Multisine)]
    if not multisines:
        raise UsageError(
            "no operator of kind 'multisine' in the scenario moves an arm, so that the "
            "reaction of a hand cannot be distinguished from its own movements (docs/ports.md)"
        )
    frequencies = [float(hz) for multisine in multisines for hz in multisine.frequencies_hz]
    return _Sines(
        hz=np.unique(frequencies),
        start_s=max(multisine.start_s for multisine in multisines),
        end_s=min(multisine.end_s for multisine in multisines),
    )


def _compute_hand_force(records: AlignedRecords, scenario: Scenario) -> tuple[Array, Array]:
    """Returns the force of the hand ON the end effector, N, and its position, m.

    Both have the shape (K, n).
    """
    split = split_torque(records, scenario)
    scripted_torque = np.zeros_like(records.q)
    for hand in scenario.sites[records.site].hands:
        source = hand.actor
        if source.kind in SCRIPTED_KINDS:
            scripted_torque += compute_operator_script(
                source, records.nominal_s, split.end_effector.J[0]
            )
    force = split.end_effector.find_force(split.operator - scripted_torque)
    return force, split.end_effector.position


def _compute_phasors(
    records: AlignedRecords, columns: Array, hz: Array, start_s: float, segment_s: float
) -> list[Complex]:
    """Returns the phasors of columns in each segment, shape (F, columns).

    Segments have Hann's window and overlap by half. The spectrum of the window is zero at the
    other sines, which are two or more multiples of 1 / segment_s away. It falls with the third
    power of frequency, so that transients and drift, which are slower than the sines, hardly
    contribute. The first half segment is left out.

    Args:
        records: the records.
        columns: signals, shape (K, columns).
        hz: the frequencies, shape (F,), Hz.
        start_s: time from which all sines act, s.
        segment_s: duration of a segment, s.
    """
    count = round(segment_s * records.rate_hz)
    half_s = 0.5 * segment_s
    first = round((start_s + half_s) * records.rate_hz) - records.first
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(count) / count)
    phasors = []
    for begin in range(max(first, 0), len(columns) - count + 1, count // 2):
        rows = slice(begin, begin + count)
        if records.known[rows].mean() < LEAST_KNOWN:
            continue
        carriers = np.exp(-2j * np.pi * np.outer(hz, records.t_s[rows]))
        centred = columns[rows] - window @ columns[rows] / window.sum()
        phasors.append(2.0 / window.sum() * (carriers * window) @ centred)
    return phasors


def _compute_coherence(phasors: Complex) -> Array:
    """Returns |mean|^2 / mean of |.|^2 over segments and all axes, shape (F,)."""
    power = (np.abs(phasors) ** 2).mean(axis=0).sum(axis=1)
    mean_power = (np.abs(phasors.mean(axis=0)) ** 2).sum(axis=1)
    coherence: Array = mean_power / np.maximum(power, 1e-300)
    return coherence


class _HandFit(NamedTuple):
    """A fit of mass, damping and stiffness.

    Attributes:
        matrices: M, B and K, shape (3, n, n).
        halves: half the width of their 95 % intervals, shape (3, n, n).
        unexplained: share of the force that the fit does not explain, shape (F,).
    """

    matrices: Array
    halves: Array
    unexplained: Array


def _fit_with_intervals(site: str, F: Complex, X: Complex, w: Array) -> _HandFit:
    """Returns the fit of M, B and K to phasors, with jackknife intervals.

    Args:
        site: name of the site, for the error message.
        F: phasors of the force, shape (segments, F, n), N.
        X: phasors of the position, shape (segments, F, n), m.
        w: the frequencies, shape (F,), rad/s.

    Raises:
        UsageError: the motions do not distinguish the axes, or mass, damping and stiffness.
    """
    count, _, axes = X.shape
    s = 1j * w[:, np.newaxis]
    motions = -np.concatenate((s**2 * X, s * X, X), axis=2)
    design = _stack_real(motions.mean(axis=0))
    normalised = design / np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    singular_values = np.linalg.svd(normalised, compute_uv=False)
    is_singular = singular_values[-1] * FARTHEST_CONDITION < singular_values[0]
    if len(design) < design.shape[1] or is_singular:
        raise UsageError(
            f"{site}: its end effector moved along fewer than {count_nouns(axes, 'axis')}, "
            "or at too few frequencies to distinguish mass, damping and stiffness: "
            "let sines of other frequencies act on another joint"
        )
    all_segments = np.arange(count)
    forces = F.transpose(2, 0, 1)
    estimate = np.array([_fit(force, motions, all_segments) for force in forces])
    # the jackknife leaves out one segment at a time
    partial_estimates = []
    for n in range(count):
        others = all_segments[all_segments != n]
        partial_estimates.append([_fit(force, motions, others) for force in forces])
    pseudo_values = count * estimate - (count - 1) * np.array(partial_estimates)
    # neighbouring segments overlap and are correlated, which widens the interval
    inflation = 1.0 + 2.0 * NEIGHBOURS * (count - 1) / count
    deviation = pseudo_values.std(axis=0, ddof=1)
    halves = stdtrit(count - 1, 0.975) * deviation * np.sqrt(inflation / count)
    force = F.mean(axis=0)
    residual = np.linalg.norm(force - motions.mean(axis=0) @ estimate.T, axis=1)
    return _HandFit(
        matrices=estimate.reshape(axes, 3, axes).transpose(1, 0, 2),
        halves=halves.reshape(axes, 3, axes).transpose(1, 0, 2),
        unexplained=residual / np.maximum(np.linalg.norm(force, axis=1), 1e-300),
    )


def _stack_real(phasors: Complex) -> Array:
    """Returns real parts and then imaginary parts along the first axis."""
    return np.concatenate((phasors.real, phasors.imag))


def _fit(force: Complex, motions: Complex, chosen: NDArray[np.int64]) -> Array:
    """Returns the rows of M, B and K for the force along one axis, shape (3 n,).

    It is a weighted least-squares fit. The mean error of each frequency is divided by its
    spread over the segments under the same M, B and K: motion is noisy as well, and the hand's
    own movements move the arm.

    Args:
        force: phasors of the force, shape (segments, F).
        motions: phasors of -(acceleration, velocity, position), shape (segments, F, 3 n).
        chosen: indices of the segments that are averaged.
    """
    mean_motion = motions[chosen].mean(axis=0)
    mean_force = force[chosen].mean(axis=0)

    def compute_residuals(numbers: Array) -> Array:
        errors = force - motions @ numbers
        spread = np.maximum(errors.std(axis=0), 1e-6 * np.abs(mean_force).max())
        return _stack_real((mean_force - mean_motion @ numbers) / spread)

    design = _stack_real(mean_motion)
    start = np.linalg.lstsq(design, _stack_real(mean_force), rcond=None)[0]
    numbers: Array = least_squares(compute_residuals, start, x_scale="jac").x
    return numbers


def read_hands(files: Sequence[str | Path]) -> list[HandMatrices]:
    """Returns the hands in files from `trilat identify hand --json`.

    Raises:
        UsageError: a file does not contain a hand.
    """
    return [_read_hand(Path(file)) for file in files]


def _read_hand(file: Path) -> HandMatrices:
    """Returns the hand in a file, or raises UsageError."""
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        M, B, K = (np.array(values[key], dtype=np.float64) for key in KEYS)
        if not M.shape == B.shape == K.shape or M.shape not in ((2, 2), (3, 3)):
            raise ValueError("its matrices have different shapes")
        if not np.isfinite([M, B, K]).all():
            raise ValueError("its numbers are not finite")
    except (OSError, ValueError, KeyError, TypeError) as error:
        problem = f"{type(error).__name__} {error}" if isinstance(error, KeyError) else error
        raise UsageError(
            f"{file}: contains no hand of `trilat identify hand --json`: {problem}"
        ) from None
    return HandMatrices(M, B, K)
