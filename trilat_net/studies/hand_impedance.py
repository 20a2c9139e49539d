"""Mass, damping and stiffness of the hand at an arm, from a log in which sines move that arm.

Somebody holds the arm of a site while an operator of kind `multisine`, at whatever site, moves
it. Force and place follow the sines, and what else the person does, does not: at the
frequencies of the sines

    F(j w) = -(M (j w)^2 + B j w + K) X(j w),

so that means over segments of a run give the same M, B and K whatever passes between, as with
an instrument. Intervals are of the jackknife over segments.

Invariant: force is that of the hand ON the arm, N, and less the sines if they act at the same
site.

Source: E. J. Perreault, R. F. Kirsch, A. M. Acosta, "Multiple-input, multiple-output system
identification for characterization of limb stiffness dynamics", Biological Cybernetics 80
(1999), for stiffness along both axes at once; R. Pintelon, J. Schoukens, "System
identification: a frequency domain approach" (2012), ch. 2 and 7, for sines in a loop; B. Efron,
"The jackknife, the bootstrap and other resampling plans" (1982).
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
LEAST_KNOWN = 0.98
"""How many segments an interval needs; which share of a segment's records."""
NEIGHBOURS = 1.0 / 6.0
"""Correlation of two segments under Hann's window that overlap by half, of what is white."""
FARTHEST_CONDITION = 1e3
"""Of motions that are told apart by axis: the ratio of the largest to the least singular value.
"""
KEYS = {"mass_kg": "M", "damping_n_s_m": "B", "stiffness_n_m": "K"}
"""Of JSON, for what each letter stands."""
UNITS = {"M": "kg", "B": "N s/m", "K": "N/m"}


class SineResponse(NamedTuple):
    """What one frequency has done.

    Attributes:
        hz: the frequency.
        motion_mm, force_n: amplitudes, over all axes.
        coherence: of motion and of force with the sines, the lesser one: 1 if every segment is
            alike.
        unexplained: the share of the force that M, B and K leave.
    """

    hz: float
    motion_mm: float
    force_n: float
    coherence: float
    unexplained: float


@dataclass(frozen=True, repr=False)
class HandImpedance(Result):
    """The hand that was found.

    Attributes:
        site: whose arm it held. M, B, K: mass, kg, damping, N s/m, and stiffness, N/m: force
        along the row's axis by motion along the
            column's, shape (n, n).
        halves: half the width of their 95 % intervals, by the same letters.
        segments: over how many segments of `segment_s`, s, means were taken.
        responses: by frequency.
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
        """Returns it as `trilat identify hand --json`, which `trilat linear --operators` takes."""
        found = {name: getattr(self, letter).tolist() for name, letter in KEYS.items()}
        halves = {f"{name}_half": self.halves[letter].tolist() for name, letter in KEYS.items()}
        over = {"site": self.site, "segments": self.segments, "segment_s": self.segment_s}
        return {**over, **found, **halves, "hand": self.to_hand(), "sines": self.to_rows()}

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row for each frequency."""
        return [one._asdict() for one in self.responses]

    def to_hand(self) -> dict[str, Any]:
        """Returns the operator of a scenario that is nearest: `[[sites.m1.hands]]`; it has no
        mass.
        """
        along = {"stiffness_n_m": self.K, "damping_n_s_m": self.B}
        numbers = {
            key: [max(0.0, float(f"{x:.4g}")) for x in np.diag(one)]
            for key, one in along.items()
        }
        return {"kind": "tip_spring", **numbers}

    def blocks(self) -> Iterator[Block]:
        """Yields its text."""
        yield (
            f"hand at {self.site}: {count_nouns(self.segments, 'segment')} of "
            f"{self.segment_s:g} s, intervals of 95 %"
        )
        axes = "xyz"[: len(self.K)]
        pairs = [(i, j) for i in range(len(axes)) for j in range(len(axes))]
        rows = [
            (f"{letter}, {UNITS[letter]}", *(
                f"{getattr(self, letter)[at]:.4g} +- {self.halves[letter][at]:.2g}" for at in pairs
            ))
            for letter in UNITS
        ]  # fmt: skip
        yield TextTable(("", *(axes[i] + axes[j] for i, j in pairs)), rows, align="lr")
        sines = [tuple(f"{x:.3g}" for x in one) for one in self.responses]
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
    """Returns mass, damping and stiffness of the hand at an arm; the command is `trilat
    identify hand`.

    >>> hand = tn.identify_hand("run.mcap", "m1")  # doctest: +SKIP
    >>> hand.K.diagonal(), hand.halves["K"].diagonal()  # doctest: +SKIP

    Raises:
        UsageError: no such site, no sines, too short a run, or a motion along fewer axes than
            the arm has.
    """
    log = log if isinstance(log, Log) else open_log(log)
    scenario = log.scenario
    find_site(scenario, site)
    hz, start_s, end_s = _find_sines(scenario)
    records = align_records(log)[site]
    force, at = _find_hand_force(records, scenario)
    between = np.diff(np.concatenate([[0.0], hz]))
    segment_s = float(np.round(2.0 / between.min(), 9))
    acting = np.hstack((force, at))[records.t_s < end_s]
    phasors = _find_phasors(
        records=records, columns=acting, hz=hz, start_s=start_s, segment_s=segment_s
    )
    if len(phasors) < LEAST_SEGMENTS:
        needed_s = start_s + (0.5 * LEAST_SEGMENTS + 1.0) * segment_s
        raise UsageError(
            f"{site}: {count_nouns(len(phasors), 'whole segment')} of {segment_s:g} s while "
            "the sines act, and intervals "
            f"need {LEAST_SEGMENTS}: at least {needed_s:g} s of them"
        )
    F, X = np.split(np.array(phasors), [force.shape[1]], axis=2)
    whole, halves, unexplained = _fit_with_intervals(site, F, X, 2.0 * np.pi * hz)
    M, B, K = whole
    named = dict(zip(UNITS, halves, strict=True))
    coherence = np.minimum(_cohere(F), _cohere(X))
    sizes = 1e3 * np.linalg.norm(X.mean(axis=0), axis=1), np.linalg.norm(F.mean(axis=0), axis=1)
    rows = zip(hz, *sizes, coherence, unexplained, strict=True)
    responses = tuple(SineResponse(*map(float, row)) for row in rows)
    return HandImpedance(site, M, B, K, named, len(phasors), segment_s, responses)


def _find_sines(scenario: Scenario) -> tuple[Array, float, float]:
    """Returns the frequencies of all sines, Hz, in order, and from when and until when they all
    act, s.
    """
    sines = [
        one
        for spec in scenario.sites.values()
        for one in spec.hands
        if isinstance(one, Multisine)
    ]
    if not sines:
        raise UsageError(
            "no operator of kind 'multisine' in the scenario moves an arm, so nothing tells a hand's force "
            "from what it does by itself (docs/ports.md)"
        )
    hz = np.unique([float(f) for one in sines for f in one.frequencies_hz])
    return hz, max(one.start_s for one in sines), min(one.end_s for one in sines)


def _find_hand_force(records: AlignedRecords, scenario: Scenario) -> tuple[Array, Array]:
    """Returns the force of the hand ON the end effector, N, and where that is, m, shape (K, n)."""
    split = split_torque(records, scenario)
    torque = np.zeros_like(records.q)
    for source in (one.actor for one in scenario.sites[records.site].hands):
        if source.kind in SCRIPTED_KINDS:
            torque += compute_operator_script(
                source, records.nominal_s, split.end_effector.J[0]
            )
    return split.end_effector.find_force(split.operator - torque), split.end_effector.position


def _find_phasors(
    records: AlignedRecords, columns: Array, hz: Array, start_s: float, segment_s: float
) -> list[Complex]:
    """Returns the phasors of columns at frequencies in each segment, shape (F, columns).

    Segments have Hann's window and overlap by half. The window is zero at the other sines, two
    or more multiples of the segment's own frequency away, and falls with the third power of
    what is slower than they are: what still settles, or drifts, is none of them. The first half
    segment is left out.
    """
    count = round(segment_s * records.rate_hz)
    half = 0.5 * segment_s
    first = round((start_s + half) * records.rate_hz) - records.first
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(count) / count)
    found = []
    for begin in range(max(first, 0), len(columns) - count + 1, count // 2):
        rows = slice(begin, begin + count)
        if records.known[rows].mean() < LEAST_KNOWN:
            continue
        turns = np.exp(-2j * np.pi * np.outer(hz, records.t_s[rows]))
        moved = columns[rows] - window @ columns[rows] / window.sum()
        found.append(2.0 / window.sum() * (turns * window) @ moved)
    return found


def _cohere(phasors: Complex) -> Array:
    """Returns |mean|^2 / mean of |.|^2 over segments, over all axes, shape (F,)."""
    power = (np.abs(phasors) ** 2).mean(axis=0).sum(axis=1)
    alike: Array = (np.abs(phasors.mean(axis=0)) ** 2).sum(axis=1) / np.maximum(power, 1e-300)
    return alike


def _fit_with_intervals(
    site: str, F: Complex, X: Complex, w: Array
) -> tuple[Array, Array, Array]:
    """Returns M, B and K, half their intervals, shape (3, n, n), and what of the force is left."""
    count, _, axes = X.shape
    s = 1j * w[:, np.newaxis]
    motions = -np.concatenate((s**2 * X, s * X, X), axis=2)
    whole = _stack(motions.mean(axis=0))
    lengths = np.linalg.svd(
        whole / np.maximum(np.linalg.norm(whole, axis=0), 1e-300), compute_uv=False
    )
    if len(whole) < whole.shape[1] or lengths[-1] * FARTHEST_CONDITION < lengths[0]:
        raise UsageError(
            f"{site}: its end effector moved along fewer than {count_nouns(axes, 'axis')}, "
            "or at too few frequencies to tell "
            "mass, damping and stiffness apart: let sines of other frequencies act on another joint"
        )
    every = np.arange(count)
    found = np.array([_fit(force, motions, every) for force in F.transpose(2, 0, 1)])
    others = np.array(
        [
            [_fit(force, motions, every[every != n]) for force in F.transpose(2, 0, 1)]
            for n in range(count)
        ]
    )
    pseudo = count * found - (count - 1) * others
    alike = 1.0 + 2.0 * NEIGHBOURS * (count - 1) / count
    halves = stdtrit(count - 1, 0.975) * pseudo.std(axis=0, ddof=1) * np.sqrt(alike / count)
    force = F.mean(axis=0)
    missed = np.linalg.norm(force - motions.mean(axis=0) @ found.T, axis=1)
    by_letter = [one.reshape(axes, 3, axes).transpose(1, 0, 2) for one in (found, halves)]
    return (
        by_letter[0],
        by_letter[1],
        missed / np.maximum(np.linalg.norm(force, axis=1), 1e-300),
    )


def _stack(phasors: Complex) -> Array:
    return np.concatenate((phasors.real, phasors.imag))


def _fit(force: Complex, motions: Complex, chosen: NDArray[np.int64]) -> Array:
    """Returns what fits the force along one axis, shape (S, F), over some segments: M, B, K,
    shape (3 n,).

    The mean error of each frequency counts by its spread over the segments, which is that of
    these very
    numbers: motion is noisy as well, and what a hand does by itself moves the arm.
    """
    means = motions[chosen].mean(axis=0), force[chosen].mean(axis=0)

    def err(numbers: Array) -> Array:
        left = force - motions @ numbers
        spread = np.maximum(left.std(axis=0), 1e-6 * np.abs(means[1]).max())
        return _stack((means[1] - means[0] @ numbers) / spread)

    start = np.linalg.lstsq(_stack(means[0]), _stack(means[1]), rcond=None)[0]
    found: Array = least_squares(err, start, x_scale="jac").x
    return found


def read_hands(files: Sequence[str | Path]) -> list[HandMatrices]:
    """Returns the hands of files that `trilat identify hand --json` has written.

    Raises:
        UsageError: a file is none.
    """
    found = []
    for file in files:
        try:
            told = json.loads(Path(file).read_text(encoding="utf-8"))
            matrices = [np.array(told[key], dtype=np.float64) for key in KEYS]
            if len({one.shape for one in matrices}) > 1 or matrices[0].shape not in (
                (2, 2),
                (3, 3),
            ):
                raise ValueError("its matrices are not alike")
            if not np.isfinite(matrices).all():
                raise ValueError("its numbers are not finite")
        except (OSError, ValueError, KeyError, TypeError) as error:
            problem = (
                f"{type(error).__name__} {error}" if isinstance(error, KeyError) else error
            )
            raise UsageError(
                f"{file}: holds no hand of `trilat identify hand --json`: {problem}"
            ) from None
        found.append(HandMatrices(*matrices))
    return found
