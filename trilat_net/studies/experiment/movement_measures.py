"""Measures of people's trials: smoothness, path, force, energy, throughput, forces of a pair,
questionnaires.

Invariant: a measure is a function of its samples alone. What samples cannot tell (the
smoothness of an arm that rests, the width of end points that do not spread) is None; arrays
that do not belong together and answers outside of their scale are errors. Numbers are in SI
units; samples are evenly spaced, one a row.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...core.vectors import Array
from ...errors import UsageError, count_nouns

ONSET_SHARE = 0.05
"""Of its peak: a movement begins and ends where its speed crosses it."""


def _read(name: str, values: ArrayLike, dimensions: int) -> Array:
    """Returns samples as an array of finite numbers, shape (K,) or (K, D)."""
    read = np.asarray(values, dtype=np.float64)
    if read.ndim != dimensions or not read.size:
        shape = "(K,), a number" if dimensions == 1 else "(K, D), a row"
        raise UsageError(f"{name}: shape {read.shape}; give {shape} per sample")
    if not np.isfinite(read).all():
        raise UsageError(
            f"{name}: a sample is not a finite number; leave out what was not measured"
        )
    return read


def _read_alike(**values: ArrayLike) -> list[Array]:
    """Returns several rows of samples that belong together, each of shape (K, D)."""
    read = [_read(name, value, 2) for name, value in values.items()]
    if len({one.shape for one in read}) > 1:
        shapes = ", ".join(
            f"{name} {one.shape}" for name, one in zip(values, read, strict=True)
        )
        raise UsageError(f"{shapes}: give as many samples and axes of each")
    return read


def _integrate(values: Array, rate_hz: float) -> float:
    return float(np.trapezoid(values)) / rate_hz


# --- one movement ----------------------------------------------------------------------------------------


def sparc(
    speed: ArrayLike,
    rate_hz: float,
    *,
    padding: int = 4,
    cutoff_hz: float = 10.0,
    threshold: float = 0.05,
) -> float | None:
    """Returns the spectral arc length of a movement, which is smoother the nearer it is to 0;
    None at rest.

    Args:
        speed: m/s or rad/s, shape (K,), of one movement from its begin to its end.
        rate_hz: samples a second.
        padding: zeros are appended up to 2^padding times the next power of two.
        cutoff_hz: frequencies above count as noise.
        threshold: share of the largest magnitude below which the spectrum ends.

    Source: Balasubramanian, Melendez-Calderon, Roby-Brami and Burdet, "On the analysis of
    movement smoothness", J. NeuroEngineering and Rehabilitation 12:112 (2015).
    """
    samples = _read("speed", speed, 1)
    if not samples.any():
        return None
    length = 1 << (int(np.ceil(np.log2(samples.size))) + padding)
    magnitude = np.abs(np.fft.rfft(samples, length))
    frequency_hz = np.arange(magnitude.size) * (rate_hz / length)
    magnitude = (magnitude / magnitude.max())[frequency_hz <= cutoff_hz]
    high = np.flatnonzero(magnitude >= threshold)
    if high.size == 0 or high[0] == high[-1]:
        return None
    arc = magnitude[high[0] : high[-1] + 1]
    return -float(np.hypot(np.diff(arc), 1.0 / (arc.size - 1)).sum())


def path_length_m(places: ArrayLike) -> float:
    """Returns the length of a path through places, m, shape (K, D)."""
    return float(np.linalg.norm(np.diff(_read("places", places, 2), axis=0), axis=1).sum())


def movement_time_s(
    speed: ArrayLike, rate_hz: float, *, share: float = ONSET_SHARE
) -> float | None:
    """Returns the time for which speed is at or above a share of its peak, first to last; None
    at rest.
    """
    samples = np.abs(_read("speed", speed, 1))
    if not samples.any():
        return None
    moves = np.flatnonzero(samples >= share * samples.max())
    return float(moves[-1] - moves[0]) / rate_hz


def energy_j(force: ArrayLike, velocity: ArrayLike, rate_hz: float) -> float:
    """Returns the work of a force on what moves: the integral of f'v by the trapezoidal rule.

    Args:
        force: N, shape (K, D).
        velocity: m/s, of the same shape.
        rate_hz: samples a second.
    """
    forces, velocities = _read_alike(force=force, velocity=velocity)
    return _integrate((forces * velocities).sum(axis=1), rate_hz)


# --- throughput ------------------------------------------------------------------------------------------

EFFECTIVE_WIDTH = float(np.sqrt(2.0 * np.pi * np.e))
"""4.133 standard deviations: the width that 96 % of normal end points are in."""


class Throughput(NamedTuple):
    """What a sequence of movements to targets of one distance and width came to.

    Args:
        width_m: effective width, 4.133 standard deviations of the end points along the axis of
            the task.
        distance_m: effective distance, the mean of what was moved along that axis.
        difficulty_bits: log2(distance / width + 1).
        time_s: mean movement time.
    """

    width_m: float
    distance_m: float
    difficulty_bits: float
    time_s: float

    @property
    def bits_s(self) -> float:
        """The throughput, bit/s."""
        return self.difficulty_bits / self.time_s


def measure_throughput(
    starts: ArrayLike,
    targets: ArrayLike,
    ends: ArrayLike,
    times_s: ArrayLike,
    *,
    serial: bool = False,
) -> Throughput | None:
    """Returns the throughput of movements under one condition of a user; None if end points do
    not spread.

    Args:
        starts: centres of the targets that are left, m, shape (K, D).
        targets: centres of the targets to reach, of the same shape.
        ends: where each movement ended, of the same shape.
        times_s: how long each took, shape (K,).
        serial: each movement begins where the last one ended, as around a ring: what that one
            went beyond its target is moved as well.

    Source: ISO/TS 9241-411 (2012); Soukoreff and MacKenzie, "Towards a standard for pointing
    device evaluation", Int. J. Human-Computer Studies 61 (2004). As MacKenzie's class
    `Throughput` computes it.
    """
    left, aims, reached = _read_alike(starts=starts, targets=targets, ends=ends)
    times = _read("times_s", times_s, 1)
    if times.size != len(aims) or not (times > 0.0).all():
        raise UsageError(f"times_s: give a time above 0 for each of {len(aims)} movements")
    lengths = np.linalg.norm(aims - left, axis=1)
    if not lengths.all():
        raise UsageError("starts: a target is left for itself; give the one before it")
    beyond = ((reached - aims) * (aims - left)).sum(axis=1) / lengths
    moved = lengths + beyond
    if serial:
        moved[1:] += beyond[:-1]
    width = EFFECTIVE_WIDTH * float(np.std(beyond, ddof=1)) if beyond.size > 1 else 0.0
    distance = float(moved.mean())
    if width <= 1e-12 * float(lengths.max()) or distance <= 0.0:
        return None
    return Throughput(
        width, distance, float(np.log2(distance / width + 1.0)), float(times.mean())
    )


# --- a pair ----------------------------------------------------------------------------------------------


def find_internal_force(first: ArrayLike, second: ArrayLike) -> Array:
    """Returns what cancels of two users' forces on an object, N, shape (K, D): as force of the
    first user.

    Where the signs of an axis differ the smaller force cancels as much of the larger one; the
    second is its negative. `internal_rms_n` of docs/metrics.md is its RMS. Source: Groten,
    Feth, Goshy, Peer, Kenny and Buss, "Experimental analysis of dominance in haptic
    collaboration", IEEE RO-MAN (2009).
    """
    one, other = _read_alike(first=first, second=second)
    opposed = np.sign(one) * np.sign(other) < 0.0
    found: Array = np.where(opposed, np.sign(one) * np.minimum(np.abs(one), np.abs(other)), 0.0)
    return found


class PairMeasures(NamedTuple):
    """What two users do to one object in a trial.

    Args:
        internal_rms_n: RMS force that cancels, of all axes and samples.
        useful_rms_n: RMS of the force that moves the object.
        internal_share: part of the forces that cancels, 0 to 1; None if nobody pushes.
        first_effort_share: part of the first user in the integral of the squared forces; None
            likewise.
        first_work_j: work of the first user on the object.
        second_work_j: work of the second.
        first_taken_j: what the first user took from the object: the integral of its negative
            power.
        second_taken_j: the same of the second.
    """

    internal_rms_n: float
    useful_rms_n: float
    internal_share: float | None
    first_effort_share: float | None
    first_work_j: float
    second_work_j: float
    first_taken_j: float
    second_taken_j: float


def measure_pair(
    first: ArrayLike, second: ArrayLike, velocity: ArrayLike, rate_hz: float
) -> PairMeasures:
    """Returns what two users do to one object.

    Args:
        first: force of the first user on the object, N, shape (K, D).
        second: force of the second, of the same shape.
        velocity: of the object, m/s, of the same shape.
        rate_hz: samples a second.
    """
    one, other, moves = _read_alike(first=first, second=second, velocity=velocity)
    internal = find_internal_force(one, other)
    sizes = np.abs(one).sum() + np.abs(other).sum()
    efforts = [float((f * f).sum()) for f in (one, other)]
    powers = [(force * moves).sum(axis=1) for force in (one, other)]
    work_j = [_integrate(power, rate_hz) for power in powers]
    taken_j = [_integrate(np.maximum(-power, 0.0), rate_hz) for power in powers]
    return PairMeasures(
        float(np.sqrt(np.mean(internal**2))),
        float(np.sqrt(np.mean((one + other) ** 2))),
        float(2.0 * np.abs(internal).sum() / sizes) if sizes else None,
        efforts[0] / sum(efforts) if sum(efforts) else None,
        *work_j,
        *taken_j,
    )


# --- questionnaires --------------------------------------------------------------------------------------

TLX_SCALES = ("mental", "physical", "temporal", "performance", "effort", "frustration")
"""Of the NASA Task Load Index; `performance` runs from good, 0, to poor, 100."""


def _rate_tlx(ratings: Mapping[str, float]) -> list[float]:
    if ratings.keys() != set(TLX_SCALES):
        raise UsageError(
            f"ratings of {', '.join(ratings) or 'nothing'}: NASA-TLX has {', '.join(TLX_SCALES)}"
        )
    for scale, rating in ratings.items():
        if not 0.0 <= rating <= 100.0:
            raise UsageError(f"{scale} = {rating}: a rating of NASA-TLX lies between 0 and 100")
    return [float(ratings[scale]) for scale in TLX_SCALES]


def raw_tlx(ratings: Mapping[str, float]) -> float:
    """Returns the mean of six ratings from 0 to 100, by scale: the raw NASA-TLX.

    Source: Hart, "NASA-Task Load Index (NASA-TLX); 20 years later", Proc. Human Factors and
    Ergonomics Society 50 (2006).
    """
    return float(np.mean(_rate_tlx(ratings)))


def weighted_tlx(ratings: Mapping[str, float], weights: Mapping[str, int]) -> float:
    """Returns the mean of six ratings from 0 to 100 by their weights.

    A weight is how often its scale was chosen in the 15 comparisons of two scales.

    Source: Hart and Staveland, "Development of NASA-TLX (Task Load Index): results of empirical
    and theoretical research", Advances in Psychology 52 (1988).
    """
    rated = _rate_tlx(ratings)
    given = [weights.get(scale, -1) for scale in TLX_SCALES]
    sums = np.cumsum(sorted(given))
    # n scales are compared with each other that often
    fewest = [n * (n - 1) // 2 for n in range(1, 7)]
    if (
        len(weights) != 6
        or any(w != int(w) for w in given)
        or sums[-1] != 15
        or (sums < fewest).any()
    ):
        raise UsageError(
            f"weights {dict(weights)}: give how often each of {', '.join(TLX_SCALES)} was chosen, 0 to 5, in "
            "the 15 comparisons of two"
        )
    return float(np.dot(rated, given) / 15.0)


def sus_score(answers: Sequence[int]) -> float:
    """Returns the score, 0 to 100, of ten answers from 1 (strongly disagree) to 5, by order of
    the questions.

    Source: Brooke, "SUS: a quick and dirty usability scale", Usability Evaluation in Industry
    (1996).
    """
    if len(answers) != 10:
        raise UsageError(f"{count_nouns(len(answers), 'answer')}: SUS has 10 questions")
    for number, answer in enumerate(answers, 1):
        if answer not in (1, 2, 3, 4, 5):
            raise UsageError(f"answer {number} = {answer}: an answer of SUS is 1, 2, 3, 4 or 5")
    return 2.5 * sum(
        answer - 1 if n % 2 == 0 else 5 - answer for n, answer in enumerate(answers)
    )
