"""Measures of a trial: smoothness, path, energy, throughput, forces of a pair, questionnaires.

All numbers are in SI units. Samples are equally spaced in time, with a row for each sample.

Invariant:
    - A measure is a function of its samples alone.
    - A measure that the samples do not determine is None, for example the smoothness of an arm
      at rest or the effective width of end points that all coincide.
    - Arrays of different shapes and answers outside their scale are errors.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...core.vectors import Array
from ...errors import UsageError, count_nouns

ONSET_SHARE = 0.05
"""Share of the peak speed at which a movement starts and ends."""


def _read(name: str, values: ArrayLike, dimensions: int) -> Array:
    """Returns samples as an array of finite numbers, shape (K,) or (K, D)."""
    samples = np.asarray(values, dtype=np.float64)
    if samples.ndim != dimensions or not samples.size:
        shape = "(K,), a number" if dimensions == 1 else "(K, D), a row"
        raise UsageError(f"{name}: shape {samples.shape}; give {shape} per sample")
    if not np.isfinite(samples).all():
        raise UsageError(
            f"{name}: a sample is not a finite number; leave out what was not measured"
        )
    return samples


def _read_same_shape(**values: ArrayLike) -> list[Array]:
    """Returns several arrays of samples, all of the same shape (K, D)."""
    arrays = {name: _read(name, value, 2) for name, value in values.items()}
    if len({array.shape for array in arrays.values()}) > 1:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise UsageError(f"{shapes}: give as many samples and axes of each")
    return list(arrays.values())


def _integrate(values: Array, rate_hz: float) -> float:
    """Returns the integral over time of samples, shape (K,), by the trapezoidal rule."""
    return float(np.trapezoid(values)) / rate_hz


# --- one movement -----------------------------------------------------------------------------


def sparc(
    speed: ArrayLike,
    rate_hz: float,
    *,
    padding: int = 4,
    cutoff_hz: float = 10.0,
    threshold: float = 0.05,
) -> float | None:
    """Returns the spectral arc length of a movement (SPARC), None at rest.

    The value is negative; a value closer to 0 means a smoother movement.

    Args:
        speed: speed of a movement from its start to its end, m/s or rad/s, shape (K,).
        rate_hz: samples per second.
        padding: the samples are padded with zeros to 2^padding times the next power of two.
        cutoff_hz: frequencies above this frequency count as noise.
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
    above = np.flatnonzero(magnitude >= threshold)
    if above.size == 0 or above[0] == above[-1]:
        return None
    arc = magnitude[above[0] : above[-1] + 1]
    lengths = np.hypot(np.diff(arc), 1.0 / (arc.size - 1))
    return -float(lengths.sum())


def path_length_m(places: ArrayLike) -> float:
    """Returns the length of a path through positions `places`, m, shape (K, D)."""
    steps = np.diff(_read("places", places, 2), axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


def movement_time_s(
    speed: ArrayLike, rate_hz: float, *, share: float = ONSET_SHARE
) -> float | None:
    """Returns the duration of a movement, s; None at rest.

    The movement lasts from the first to the last sample whose speed is at least `share` of the
    peak speed.
    """
    samples = np.abs(_read("speed", speed, 1))
    if not samples.any():
        return None
    moving = np.flatnonzero(samples >= share * samples.max())
    return float(moving[-1] - moving[0]) / rate_hz


def energy_j(force: ArrayLike, velocity: ArrayLike, rate_hz: float) -> float:
    """Returns the work of a force on a moving body: the integral of f'v, J.

    Args:
        force: force on the body, N, shape (K, D).
        velocity: velocity of the body, m/s, of the same shape.
        rate_hz: samples per second.
    """
    forces, velocities = _read_same_shape(force=force, velocity=velocity)
    return _integrate((forces * velocities).sum(axis=1), rate_hz)


# --- throughput -------------------------------------------------------------------------------

EFFECTIVE_WIDTH = float(np.sqrt(2.0 * np.pi * np.e))
"""Effective width in standard deviations: sqrt(2 pi e) = 4.133.

A range of this width holds 96 % of normally distributed end points.
"""


class Throughput(NamedTuple):
    """Throughput of a sequence of movements to targets of equal distance and width.

    Args:
        width_m: effective width, 4.133 standard deviations of the end points along the axis of
            the task.
        distance_m: effective distance, the mean distance moved along the axis of the task.
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
    """Returns the throughput of a user's movements under a condition.

    The throughput is None if the end points do not spread.

    Args:
        starts: centres of the targets from which the movements start, m, shape (K, D).
        targets: centres of the targets to reach, m, of the same shape.
        ends: end points of the movements, m, of the same shape.
        times_s: duration of each movement, s, shape (K,).
        serial: whether each movement starts at the end point of the previous movement, as
            around a ring. The overshoot of the previous movement then adds to the distance.

    Source: ISO/TS 9241-411 (2012); Soukoreff and MacKenzie, "Towards a standard for pointing
    device evaluation", Int. J. Human-Computer Studies 61 (2004). As MacKenzie's class
    `Throughput` computes it.
    """
    start_points, target_points, end_points = _read_same_shape(
        starts=starts, targets=targets, ends=ends
    )
    times = _read("times_s", times_s, 1)
    count = len(target_points)
    if times.size != count or not (times > 0.0).all():
        raise UsageError(f"times_s: give a time above 0 for each of {count} movements")
    axes = target_points - start_points
    lengths = np.linalg.norm(axes, axis=1)
    if not lengths.all():
        raise UsageError("starts: a target is left for itself; give the one before it")
    overshoots = ((end_points - target_points) * axes).sum(axis=1) / lengths
    distances = lengths + overshoots
    if serial:
        distances[1:] += overshoots[:-1]
    width = 0.0
    if overshoots.size > 1:
        width = EFFECTIVE_WIDTH * float(np.std(overshoots, ddof=1))
    distance = float(distances.mean())
    if width <= 1e-12 * float(lengths.max()) or distance <= 0.0:
        return None
    return Throughput(
        width_m=width,
        distance_m=distance,
        difficulty_bits=float(np.log2(distance / width + 1.0)),
        time_s=float(times.mean()),
    )


# --- a pair -----------------------------------------------------------------------------------


def find_internal_force(first: ArrayLike, second: ArrayLike) -> Array:
    """Returns the first user's part of the forces on an object that cancel, N, shape (K, D).

    If the two users' forces along an axis have opposite signs, the smaller force cancels an
    equal part of the larger force; otherwise no force cancels. The second user's part is the
    negative of the first user's. `internal_rms_n` in docs/metrics.md is the RMS of this force.

    Source: Groten, Feth, Goshy, Peer, Kenny and Buss, "Experimental analysis of dominance in
    haptic collaboration", IEEE RO-MAN (2009).
    """
    first_force, second_force = _read_same_shape(first=first, second=second)
    are_opposed = np.sign(first_force) * np.sign(second_force) < 0.0
    smaller = np.minimum(np.abs(first_force), np.abs(second_force))
    internal: Array = np.where(are_opposed, np.sign(first_force) * smaller, 0.0)
    return internal


class PairMeasures(NamedTuple):
    """Forces and work of two users on a shared object in a trial.

    Args:
        internal_rms_n: RMS of the force that cancels, over all axes and samples.
        useful_rms_n: RMS of the sum of both forces, which moves the object.
        internal_share: part of the forces that cancels, 0 to 1; None if both forces are zero.
        first_effort_share: the first user's part of the integral of the squared forces; None
            if both forces are zero.
        first_work_j: work of the first user on the object.
        second_work_j: work of the second user on the object.
        first_taken_j: energy that the first user absorbs: the integral of the negative part of
            the user's power.
        second_taken_j: energy that the second user absorbs, likewise.
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
    """Returns the forces and the work of two users on a shared object.

    Args:
        first: force of the first user on the object, N, shape (K, D).
        second: force of the second user on the object, N, of the same shape.
        velocity: velocity of the object, m/s, of the same shape.
        rate_hz: samples per second.
    """
    first_force, second_force, velocities = _read_same_shape(
        first=first, second=second, velocity=velocity
    )
    internal = find_internal_force(first_force, second_force)
    sizes = np.abs(first_force).sum() + np.abs(second_force).sum()
    first_effort = float((first_force * first_force).sum())
    second_effort = float((second_force * second_force).sum())
    effort = first_effort + second_effort
    first_power = (first_force * velocities).sum(axis=1)
    second_power = (second_force * velocities).sum(axis=1)
    return PairMeasures(
        internal_rms_n=float(np.sqrt(np.mean(internal**2))),
        useful_rms_n=float(np.sqrt(np.mean((first_force + second_force) ** 2))),
        internal_share=float(2.0 * np.abs(internal).sum() / sizes) if sizes else None,
        first_effort_share=first_effort / effort if effort else None,
        first_work_j=_integrate(first_power, rate_hz),
        second_work_j=_integrate(second_power, rate_hz),
        first_taken_j=_integrate(np.maximum(-first_power, 0.0), rate_hz),
        second_taken_j=_integrate(np.maximum(-second_power, 0.0), rate_hz),
    )


# --- questionnaires ---------------------------------------------------------------------------

TLX_SCALES = ("mental", "physical", "temporal", "performance", "effort", "frustration")
"""Scales of the NASA Task Load Index; `performance` runs from good, 0, to poor, 100."""


def _list_ratings(ratings: Mapping[str, float]) -> list[float]:
    """Returns the six ratings in the order of `TLX_SCALES`.

    Raises:
        UsageError: a scale is missing or unknown, or a rating is not between 0 and 100.
    """
    if ratings.keys() != set(TLX_SCALES):
        raise UsageError(
            f"ratings of {', '.join(ratings) or 'nothing'}: "
            f"NASA-TLX has {', '.join(TLX_SCALES)}"
        )
    for scale, rating in ratings.items():
        if not 0.0 <= rating <= 100.0:
            raise UsageError(f"{scale} = {rating}: a rating of NASA-TLX lies between 0 and 100")
    return [float(ratings[scale]) for scale in TLX_SCALES]


def raw_tlx(ratings: Mapping[str, float]) -> float:
    """Returns the raw NASA-TLX: the mean of six ratings from 0 to 100, given by scale.

    Source: Hart, "NASA-Task Load Index (NASA-TLX); 20 years later", Proc. Human Factors and
    Ergonomics Society 50 (2006).
    """
    return float(np.mean(_list_ratings(ratings)))


def weighted_tlx(ratings: Mapping[str, float], weights: Mapping[str, int]) -> float:
    """Returns the weighted mean of six ratings from 0 to 100, given by scale.

    The weight of a scale is the number of times that the scale was chosen in the 15 comparisons
    of two scales.

    Source: Hart and Staveland, "Development of NASA-TLX (Task Load Index): results of empirical
    and theoretical research", Advances in Psychology 52 (1988).
    """
    ordered_ratings = _list_ratings(ratings)
    ordered_weights = [weights.get(scale, -1) for scale in TLX_SCALES]
    sums = np.cumsum(sorted(ordered_weights))
    # any n scales are compared with each other n (n - 1) / 2 times, and each comparison adds 1
    least_sums = [n * (n - 1) // 2 for n in range(1, 7)]
    has_all = len(weights) == 6
    is_whole = has_all and all(weight == int(weight) for weight in ordered_weights)
    is_possible = sums[-1] == 15 and not (sums < least_sums).any()
    if not is_whole or not is_possible:
        raise UsageError(
            f"weights {dict(weights)}: give how often each of {', '.join(TLX_SCALES)} "
            "was chosen, 0 to 5, in the 15 comparisons of two"
        )
    return float(np.dot(ordered_ratings, ordered_weights) / 15.0)


def sus_score(answers: Sequence[int]) -> float:
    """Returns the score of the System Usability Scale, 0 to 100.

    The ten answers are from 1 (strongly disagree) to 5, in the order of the questions.

    Source: Brooke, "SUS: a quick and dirty usability scale", Usability Evaluation in Industry
    (1996).
    """
    if len(answers) != 10:
        raise UsageError(f"{count_nouns(len(answers), 'answer')}: SUS has 10 questions")
    for number, answer in enumerate(answers, 1):
        if answer not in (1, 2, 3, 4, 5):
            raise UsageError(f"answer {number} = {answer}: an answer of SUS is 1, 2, 3, 4 or 5")
    # odd questions are worded positively, even questions negatively
    positive = sum(answer - 1 for answer in answers[::2])
    negative = sum(5 - answer for answer in answers[1::2])
    return 2.5 * (positive + negative)
