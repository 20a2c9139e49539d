"""Measures of human movement and cooperation, each with a published definition.

A measure takes arrays of samples that are equally spaced in time, with one row per sample, and
returns a number. All quantities are in SI units.

| measure | function |
|---|---|
| smoothness of a movement | `sparc` |
| length, duration, work | `path_length_m`, `movement_time_s`, `energy_j` |
| speed and accuracy of aimed movements | `measure_throughput` |
| forces and work of two users on one object | `measure_pair` |
| workload and usability by questionnaire | `raw_tlx`, `weighted_tlx`, `sus_score` |

Invariant:
    - A measure depends only on its samples.
    - A measure is `None` if it is undefined for the samples, for example the smoothness of an
      arm at rest, or the effective width of coincident end points.
    - Arrays of different shapes and answers outside their scale raise an error.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trilat_net.core import Array
from trilat_net.errors import UsageError, count_nouns

ONSET_SHARE = 0.05
"""Fraction of the peak speed at which a movement starts and ends."""


def _read(name: str, values: ArrayLike, dimensions: int) -> Array:
    """Converts samples of a movement to an array of finite numbers, shape (K,) or (K, D).

    K is the number of samples, and D is the number of coordinates.

    Args:
        name: Name of the samples, for error messages.
        values: The samples.
        dimensions: 1 for shape (K,), 2 for shape (K, D).

    Raises:
        UsageError: The array has a different shape, or a sample is not finite.
    """
    samples = np.asarray(values, dtype=np.float64)
    if samples.ndim != dimensions or not samples.size:
        shape = "(K,), with a number" if dimensions == 1 else "(K, D), with a row"
        raise UsageError(
            f"{name}: the array has shape {samples.shape}; give shape {shape} per sample"
        )
    if not np.isfinite(samples).all():
        raise UsageError(
            f"{name}: a sample is not a finite number; "
            "leave out the samples that were not measured"
        )
    return samples


def _read_same_shape(**values: ArrayLike) -> list[Array]:
    """Converts several time series to arrays of floats with the same shape.

    Args:
        **values: Arrays of K samples with D axes, shape (K, D), named as in error messages.

    Raises:
        UsageError: The shapes differ, or a sample is not finite.
    """
    arrays = {name: _read(name, value, 2) for name, value in values.items()}
    distinct_shapes = {array.shape for array in arrays.values()}
    if len(distinct_shapes) > 1:
        shapes_text = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise UsageError(
            f"{shapes_text}: give the same number of samples and axes in each array"
        )
    return list(arrays.values())


def _integrate(values: Array, rate_hz: float) -> float:
    """Integrates K equally spaced samples over time with the trapezoidal rule.

    Args:
        values: The samples, at a constant rate.
        rate_hz: Sample rate, in Hz.

    Returns:
        The integral, in the unit of the samples times s.
    """
    return float(np.trapezoid(values)) / rate_hz


def _compute_rms(values: Array) -> float:
    """Returns the root mean square of all entries of an array."""
    return float(np.sqrt(np.mean(values**2)))


# --- one movement -----------------------------------------------------------------------------


def sparc(
    speed: ArrayLike,
    rate_hz: float,
    *,
    padding: int = 4,
    cutoff_hz: float = 10.0,
    threshold: float = 0.05,
) -> float | None:
    """Computes the spectral arc length (SPARC), a measure of the smoothness of a movement.

    The value is negative, and closer to 0 for a smoother movement. The speed spectrum of a
    jerky movement has more bumps, so the curve of the spectrum is longer.

    Args:
        speed: Speed from the start to the end of the movement, in m/s or rad/s, shape (K,).
        rate_hz: Sample rate, in Hz.
        padding: Zero-padding exponent: the samples are padded to 2^padding times the next power
            of two.
        cutoff_hz: Frequency, in Hz, above which the spectrum is treated as noise.
        threshold: Fraction of the largest magnitude below which the spectrum is cut off.

    Returns:
        The spectral arc length, or `None` if there was no movement.

    Source: Balasubramanian, Melendez-Calderon, Roby-Brami and Burdet, "On the analysis of
    movement smoothness", J. NeuroEngineering and Rehabilitation 12:112 (2015).
    """
    samples = _read("speed", speed, 1)
    if not samples.any():
        return None

    next_power = int(np.ceil(np.log2(samples.size)))
    padded_size = 1 << (next_power + padding)
    coefficients = np.fft.rfft(samples, padded_size)
    magnitude = np.abs(coefficients)
    spacing_hz = rate_hz / padded_size
    frequency_hz = np.arange(magnitude.size) * spacing_hz
    relative_magnitude = magnitude / magnitude.max()

    is_motion = frequency_hz <= cutoff_hz
    spectrum = relative_magnitude[is_motion]

    # The spectrum is cut to the range in which it exceeds the threshold.
    above_threshold = np.flatnonzero(spectrum >= threshold)
    if above_threshold.size == 0 or above_threshold[0] == above_threshold[-1]:
        return None

    first_index = above_threshold[0]
    last_index = above_threshold[-1]
    curve = spectrum[first_index : last_index + 1]

    # Length of the curve, whose frequency axis is scaled to run from 0 to 1.
    frequency_step = 1.0 / (curve.size - 1)
    magnitude_steps = np.diff(curve)
    segment_lengths = np.hypot(magnitude_steps, frequency_step)
    return -float(segment_lengths.sum())


def path_length_m(places: ArrayLike) -> float:
    """Computes the length of a sampled path, in m.

    Sums the lengths of the straight segments between samples, so detours and tremor increase
    the result.

    Args:
        places: Positions along the path, in m, shape (K, D).
    """
    points_m = _read("places", places, 2)
    steps = np.diff(points_m, axis=0)
    step_lengths = np.linalg.norm(steps, axis=1)
    return float(step_lengths.sum())


def movement_time_s(
    speed: ArrayLike, rate_hz: float, *, share: float = ONSET_SHARE
) -> float | None:
    """Computes the duration of a movement from its speed, in s.

    The movement lasts from the first to the last sample whose speed is at least a given
    fraction of the peak speed.

    Args:
        speed: Speed, in m/s or rad/s, shape (K,).
        rate_hz: Sample rate, in Hz.
        share: Fraction of the peak speed at which the movement starts and ends.

    Returns:
        The duration, or `None` if there was no movement.
    """
    samples = np.abs(_read("speed", speed, 1))
    if not samples.any():
        return None
    onset_speed = share * samples.max()
    moving_samples = np.flatnonzero(samples >= onset_speed)
    interval_count = moving_samples[-1] - moving_samples[0]
    return float(interval_count) / rate_hz


def energy_j(force: ArrayLike, velocity: ArrayLike, rate_hz: float) -> float:
    """Computes the work done by a force on a moving body, in J.

    The work is the time integral of f'v, where f is the force and v is the velocity.

    Args:
        force: Force on the body, in N, shape (K, D).
        velocity: Velocity of the body, in m/s, same shape as `force`.
        rate_hz: Sample rate, in Hz.
    """
    forces, velocities = _read_same_shape(force=force, velocity=velocity)
    power = (forces * velocities).sum(axis=1)
    return _integrate(power, rate_hz)


# --- throughput -------------------------------------------------------------------------------

EFFECTIVE_WIDTH = float(np.sqrt(2.0 * np.pi * np.e))
"""Effective width in standard deviations: sqrt(2 pi e) = 4.133.

A range of this width contains 96 % of normally distributed end points.
"""


class Throughput(NamedTuple):
    """Throughput of a sequence of movements to targets of the same width at the same distance.

    Throughput is a combined measure of the speed and accuracy of aimed movements.

    Args:
        width_m: Effective width: 4.133 standard deviations of the end points along the task
            axis, in m.
        distance_m: Effective distance: mean distance moved along the task axis, in m.
        difficulty_bits: Index of difficulty, log2(distance / width + 1), in bits.
        time_s: Mean movement time, in s.
    """

    width_m: float
    distance_m: float
    difficulty_bits: float
    time_s: float

    @property
    def bits_s(self) -> float:
        """Throughput in bit/s, as defined by Fitts's law.

        The index of difficulty divided by the mean movement time.
        """
        return self.difficulty_bits / self.time_s


def measure_throughput(
    starts: ArrayLike,
    targets: ArrayLike,
    ends: ArrayLike,
    times_s: ArrayLike,
    *,
    serial: bool = False,
) -> Throughput | None:
    """Computes the throughput of aimed movements, which combines speed and accuracy.

    Throughput is log2(distance / width + 1) / time, in bit/s. The effective width is 4.133
    standard deviations of the end points along the direction of movement.

    Args:
        starts: Centres of the targets at which the movements start, in m, shape (K, D).
        targets: Centres of the targets to reach, in m, same shape as `starts`.
        ends: End points of the movements, in m, same shape as `starts`.
        times_s: Duration of each movement, in s, shape (K,).
        serial: True if each movement starts at the end point of the previous one, as around a
            ring. The overshoot of the previous movement is then added to the distance.

    Returns:
        The throughput, or `None` if all end points coincide.

    Source: ISO/TS 9241-411 (2012); Soukoreff and MacKenzie, "Towards a standard for pointing
    device evaluation", Int. J. Human-Computer Studies 61 (2004). The result agrees with
    MacKenzie's class `Throughput`.
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
        raise UsageError(
            "starts: a movement must not start at its own target; "
            "give the centre of the previous target"
        )

    # Distance of each end point beyond its target, along the axis of the task.
    end_errors = end_points - target_points
    projections = (end_errors * axes).sum(axis=1)
    overshoots = projections / lengths
    distances = lengths + overshoots
    if serial:
        distances[1:] += overshoots[:-1]

    width = 0.0
    if overshoots.size > 1:
        deviation = float(np.std(overshoots, ddof=1))
        width = EFFECTIVE_WIDTH * deviation
    distance = float(distances.mean())
    # The spread of coinciding end points consists of rounding errors.
    smallest_width = 1e-12 * float(lengths.max())
    if width <= smallest_width or distance <= 0.0:
        return None

    relative_distance = distance / width
    return Throughput(
        width_m=width,
        distance_m=distance,
        difficulty_bits=float(np.log2(relative_distance + 1.0)),
        time_s=float(times.mean()),
    )


# --- a pair -----------------------------------------------------------------------------------


def find_internal_force(first: ArrayLike, second: ArrayLike) -> Array:
    """Returns the part of two users' forces on an object that cancels out, in N.

    Along an axis where the two forces have opposite signs, the smaller force cancels an equal
    part of the larger one. Otherwise, nothing cancels. The second user's part is the negative
    of the first user's part. `internal_rms_n` in docs/reference/metrics.md is the RMS of this
    force.

    Args:
        first: Force of the first user on the object, in N, shape (K, D).
        second: Force of the second user on the object, in N, same shape as `first`.

    Returns:
        The first user's part, shape (K, D).

    Source: Groten, Feth, Goshy, Peer, Kenny and Buss, "Experimental analysis of dominance in
    haptic collaboration", IEEE RO-MAN (2009).
    """
    first_force, second_force = _read_same_shape(first=first, second=second)
    first_sign = np.sign(first_force)
    second_sign = np.sign(second_force)
    are_opposed = first_sign * second_sign < 0.0
    first_size = np.abs(first_force)
    second_size = np.abs(second_force)
    cancelled = first_sign * np.minimum(first_size, second_size)
    internal: Array = np.where(are_opposed, cancelled, 0.0)
    return internal


class PairMeasures(NamedTuple):
    """Forces and work of two people who move a shared object in a trial.

    Args:
        internal_rms_n: RMS of the internal force (which cancels out), over all axes and
            samples, in N.
        useful_rms_n: RMS of the sum of both forces, which moves the object, in N.
        internal_share: Fraction of the forces that cancels out, between 0 and 1. `None` if both
            forces are zero.
        first_effort_share: First user's share of the integral of the squared forces. `None` if
            both forces are zero.
        first_work_j: Work done by the first user on the object, in J.
        second_work_j: Work done by the second user on the object, in J.
        first_taken_j: Energy absorbed by the first user, in J: the integral of the negative
            part of the user's power.
        second_taken_j: Energy absorbed by the second user, in J.
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
    """Computes the forces and work of two users who move a shared object together.

    The sum of their forces moves the object. The internal force, with which they work against
    each other, only squeezes it.

    Args:
        first: Force of the first user on the object, in N, shape (K, D).
        second: Force of the second user on the object, in N, same shape as `first`.
        velocity: Velocity of the object, in m/s, same shape as `first`.
        rate_hz: Sample rate, in Hz.
    """
    first_force, second_force, velocities = _read_same_shape(
        first=first, second=second, velocity=velocity
    )

    internal = find_internal_force(first_force, second_force)
    useful = first_force + second_force
    first_size = np.abs(first_force).sum()
    second_size = np.abs(second_force).sum()
    total_size = first_size + second_size

    internal_share = None
    if total_size:
        # Both users' parts of the internal force have the same size.
        internal_size = 2.0 * np.abs(internal).sum()
        internal_share = float(internal_size / total_size)

    first_effort = float((first_force * first_force).sum())
    second_effort = float((second_force * second_force).sum())
    effort = first_effort + second_effort
    first_effort_share = None
    if effort:
        first_effort_share = first_effort / effort

    first_power = (first_force * velocities).sum(axis=1)
    second_power = (second_force * velocities).sum(axis=1)
    first_absorbed_power = np.maximum(-first_power, 0.0)
    second_absorbed_power = np.maximum(-second_power, 0.0)
    return PairMeasures(
        internal_rms_n=_compute_rms(internal),
        useful_rms_n=_compute_rms(useful),
        internal_share=internal_share,
        first_effort_share=first_effort_share,
        first_work_j=_integrate(first_power, rate_hz),
        second_work_j=_integrate(second_power, rate_hz),
        first_taken_j=_integrate(first_absorbed_power, rate_hz),
        second_taken_j=_integrate(second_absorbed_power, rate_hz),
    )


# --- questionnaires ---------------------------------------------------------------------------

TLX_SCALES = ("mental", "physical", "temporal", "performance", "effort", "frustration")
"""Scales of the NASA Task Load Index. `performance` ranges from 0 (good) to 100 (poor)."""


def _list_ratings(ratings: Mapping[str, float]) -> list[float]:
    """Returns the six ratings of NASA-TLX in the order of `TLX_SCALES`.

    Args:
        ratings: Mapping from the name of each scale to a rating from 0 to 100.

    Raises:
        UsageError: A scale is missing or unknown, or a rating is not between 0 and 100.
    """
    if ratings.keys() != set(TLX_SCALES):
        rated = ", ".join(ratings) or "nothing"
        scales = ", ".join(TLX_SCALES)
        raise UsageError(
            f"ratings are given for {rated}, but NASA-TLX needs a rating for each of {scales}"
        )

    for scale, rating in ratings.items():
        if not 0.0 <= rating <= 100.0:
            raise UsageError(
                f"{scale} = {rating}: a rating of NASA-TLX must be between 0 and 100"
            )
    return [float(ratings[scale]) for scale in TLX_SCALES]


def raw_tlx(ratings: Mapping[str, float]) -> float:
    """Computes the raw NASA Task Load Index, a measure of how demanding a task was.

    The index is the mean of a participant's six ratings.

    Args:
        ratings: Mapping from each of `TLX_SCALES` to a rating from 0 to 100.

    Source: Hart, "NASA-Task Load Index (NASA-TLX); 20 years later", Proc. Human Factors and
    Ergonomics Society 50 (2006).
    """
    return float(np.mean(_list_ratings(ratings)))


def weighted_tlx(ratings: Mapping[str, float], weights: Mapping[str, int]) -> float:
    """Computes the weighted NASA Task Load Index, a measure of how demanding a task was.

    The index is the weighted mean of a participant's six ratings.

    Args:
        ratings: Mapping from each of `TLX_SCALES` to a rating from 0 to 100.
        weights: Mapping from scale to the number of times it was chosen in the 15 pairwise
            comparisons.

    Source: Hart and Staveland, "Development of NASA-TLX (Task Load Index): results of empirical
    and theoretical research", Advances in Psychology 52 (1988).
    """
    ratings_in_order = _list_ratings(ratings)
    weights_in_order = [weights.get(scale, -1) for scale in TLX_SCALES]
    cumulative_sums = np.cumsum(sorted(weights_in_order))
    # There are n (n - 1) / 2 comparisons between n scales, and each adds 1 to a weight.
    least_sums = [n * (n - 1) // 2 for n in range(1, 7)]
    has_all_scales = len(weights) == 6
    are_whole_numbers = has_all_scales and all(
        weight == int(weight) for weight in weights_in_order
    )
    are_possible = cumulative_sums[-1] == 15 and not (cumulative_sums < least_sums).any()
    if not are_whole_numbers or not are_possible:
        scales = ", ".join(TLX_SCALES)
        raise UsageError(
            f"weights {dict(weights)}: for each of {scales}, give how often the scale was "
            "chosen (0 to 5) in the 15 pairwise comparisons"
        )
    return float(np.dot(ratings_in_order, weights_in_order) / 15.0)


def sus_score(answers: Sequence[int]) -> float:
    """Computes the System Usability Scale (SUS) score of a participant, from 0 to 100.

    SUS is a questionnaire of ten items on the usability of a system.

    Args:
        answers: Ten answers from 1 (strongly disagree) to 5 (strongly agree), in the order of
            the questions.

    Source: Brooke, "SUS: a quick and dirty usability scale", Usability Evaluation in Industry
    (1996).
    """
    if len(answers) != 10:
        count = count_nouns(len(answers), "answer was", "answers were")
        raise UsageError(f"{count} given, but SUS has 10 questions")

    for number, answer in enumerate(answers, 1):
        if answer not in (1, 2, 3, 4, 5):
            raise UsageError(
                f"answer {number} = {answer}: "
                "an answer to a question of SUS must be 1, 2, 3, 4 or 5"
            )

    # Odd questions are worded positively, even questions negatively.
    positive_points = sum(answer - 1 for answer in answers[::2])
    negative_points = sum(5 - answer for answer in answers[1::2])
    return 2.5 * (positive_points + negative_points)
