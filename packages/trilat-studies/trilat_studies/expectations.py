"""Compares the metrics of a run with the table [expect] of its scenario.

For example, the key `peak_error_max_rad` limits the largest error.

Invariant:
    - A metric that cannot be computed for a run does not meet its limit.
"""

import re
from collections.abc import Iterator, Sequence

import msgspec

from trilat_net.analysis import LogMetrics, Stability
from trilat_net.fields import split_unit
from trilat_net.scenario import Expect

from .measure_run import RunMetrics
from .run_statistics import Range


class ExpectationResult(msgspec.Struct, frozen=True):
    """Result of comparing one metric of a run with its limit in the table [expect].

    Attributes:
        key: Key in the table [expect], or the name of a requirement that every run must meet.
        held: True if the run met the expectation.
        measured: Measured value as a string with its unit.
        limit: Limit as a string with its unit.
        margin: Distance of the measured value from the limit as a fraction of the limit,
            negative beyond the limit. `None` if the expectation is not numerical.
        value: Measured value in the unit of the limit. `None` if the expectation is not
            numerical.
    """

    key: str
    held: bool
    measured: str
    limit: str
    margin: float | None = None
    value: float | None = None

    @classmethod
    def list_of_run(cls, metrics: RunMetrics, expect: Expect) -> "list[ExpectationResult]":
        """Compares the metrics of a run with the expectations of its scenario.

        If the run diverged (an arm exceeded its limits), the expectation `stable` is always
        reported, even if the scenario does not state it.

        Args:
            metrics: Metrics of the run.
            expect: Expectations of the scenario, for example the largest permitted error.

        Returns:
            For each expectation, whether the run met it, and the measured value. The results
            are in the order of the attributes of `Expect`.
        """
        outcomes = list(_evaluate_stability(expect, metrics))
        for key in _LIMITS:
            limit = getattr(expect, key)
            if limit is not None:
                measured = _read_metric(key, metrics)
                outcomes.append(_compare_with_limit(key, measured, limit))

        outcomes += _evaluate_poses(expect, metrics)
        if expect.no_gaps:
            gaps = cls(
                key="no_gaps",
                held=metrics.missing == 0,
                measured=f"{metrics.missing} missing",
                limit="0 missing",
            )
            outcomes.append(gaps)
        outcomes += _evaluate_windows(expect, metrics)
        outcomes += _evaluate_metrics(expect, metrics)
        return outcomes


def _evaluate_stability(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Yields whether the run is as stable as the scenario's key `stable` requires.

    A run that diverged is also reported if the scenario does not state the key. Since a single
    run cannot prove stability, "settled" is the best possible verdict and counts as stable.

    Args:
        expect: Table [expect] of the scenario.
        metrics: Metrics of the run.
    """
    expects_stable = expect.stable is not False
    end = metrics.end
    if expect.stable is not None or end.diverged_at_s is not None:
        # A single run proves nothing: "settled" is the best judgement of its end.
        expected = Stability.SETTLED if expects_stable else Stability.NOT_STABLE
        measured = f"{end.stability}: {end.text}"
        limit = str(expects_stable).lower()
        held = end.stability is expected
        yield ExpectationResult("stable", held, measured, limit)


_LIMITS = tuple(key for key in Expect.__struct_fields__ if re.search("_(max|min|by)(_|$)", key))
"""Keys of [expect] that are a smallest or largest value of a metric."""


def _read_metric(key: str, metrics: RunMetrics) -> float | None:
    """Returns the metric that a key of [expect] limits.

    The key contains the name of the metric: "peak_error_max_rad" limits `peak_error_rad`, and
    "synchronised_by_s" limits `synchronised_at_s`. Keys in ms limit the sample ages on the
    worst link.

    Returns:
        The metric, or `None` if the run does not have it or a link never delivered a sample.
    """
    is_age = key.endswith("_ms")
    if not is_age:
        without_bound = re.sub("_(max|min)", "", key)
        name = without_bound.replace("_by_", "_at_")
        value: float | None = getattr(metrics, name)
        return value

    is_mean = key.startswith("mean")
    ages_ms = []
    for age in metrics.ages.values():
        age_ms = age.mean_ms if is_mean else age.max_ms
        if age_ms is None:
            return None
        ages_ms.append(age_ms)
    if not ages_ms:
        return None
    return min(ages_ms) if "_min_" in key else max(ages_ms)


def _compare_with_limit(key: str, measured: float | None, limit: float) -> ExpectationResult:
    """Compares a metric with the smallest or largest value that the scenario permits.

    Args:
        key: Key of [expect]. It contains "_min_" for a smallest value, and ends in the unit.
        measured: The metric. `None` if the run does not have it, which fails the expectation.
        limit: The limit, in the same unit.
    """
    is_minimum = "_min_" in key
    relation = "≥" if is_minimum else "≤"
    _, unit = split_unit(key)
    limit_text = f"{relation} {limit:g} {unit}".rstrip()
    if measured is None:
        return ExpectationResult(key, False, "never", limit_text)

    distance = measured - limit if is_minimum else limit - measured
    return ExpectationResult(
        key=key,
        held=distance >= 0.0,
        measured=f"{measured:.4g} {unit}".rstrip(),
        limit=limit_text,
        margin=distance / limit if limit else None,
        value=measured,
    )


def _evaluate_poses(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Compares the final pose of each arm with the pose that the scenario expects.

    Yields:
        One result per site with an expected pose, for the joint with the largest error.
    """
    tolerance_rad = expect.end_pose_within_rad
    for site, expected in expect.end_pose_rad.items():
        key = f"end_pose_rad.{site}"
        expected_angles = ", ".join(f"{angle:g}" for angle in expected)
        limit = f"({expected_angles}) ± {tolerance_rad:g} rad"

        reached = metrics.end_pose_rad.get(site)
        if reached is None:
            yield ExpectationResult(key, False, "never", limit)
            continue
        distances_rad = []
        for angle, expected_angle in zip(reached, expected, strict=True):
            distances_rad.append(abs(angle - expected_angle))
        error_rad = max(distances_rad)
        margin_rad = tolerance_rad - error_rad

        angles = ", ".join(f"{angle:.4f}" for angle in reached)
        yield ExpectationResult(
            key=key,
            held=error_rad <= tolerance_rad,
            measured=f"({angles}) rad",
            limit=limit,
            margin=margin_rad / tolerance_rad,
        )


def _evaluate_windows(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Yields the result for each quantity limited by a window of the table [expect].

    A window is a period of the run, such as 9 s to 15 s, with limits of its own.

    Args:
        expect: Table [expect] of the scenario.
        metrics: Metrics of the run.
    """
    for window, ranges in zip(expect.windows, metrics.windows, strict=True):
        site = f" {window.site}" if window.site else ""
        period = f"{window.from_s:g}-{window.to_s:g} s"
        for key, limits in window.limits:
            name = f"{key}{site} {period}"  # as in "wall_mean_n s 9-15 s"
            _, unit = split_unit(key)
            measured = ranges.get(key)
            yield _compare_with_range(name, measured, limits, unit)


def _evaluate_metrics(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Yields the result for each metric limited by the table [expect], such as "path_m".

    A metric that cannot be computed fails its limit, and the reason is reported in place of a
    value.

    Args:
        expect: Table [expect] of the scenario.
        metrics: Metrics of the run.
    """
    for key, limits in expect.metrics.items():
        value, reason, _ = metrics.metrics[key]
        measured = None if value is None else Range(value, value)
        quantity = LogMetrics.find_quantity(key)
        yield _compare_with_range(
            name=f"metrics.{key}",
            measured=measured,
            limits=limits,
            unit=quantity.unit,
            missing_text=reason,
        )


def _compare_with_range(
    name: str,
    measured: Range | None,
    limits: Sequence[float],
    unit: str,
    missing_text: str = "never",
) -> ExpectationResult:
    """Compares a quantity with the range within which it must stay.

    Args:
        name: Name of the expectation.
        measured: Smallest and largest value of the quantity. `None` if the run does not have
            it, which fails the expectation.
        limits: Lower and upper limit.
        unit: Unit of the quantity.
        missing_text: Text to show in place of a missing value.

    Returns:
        The result. Its margin is relative to half the width of the permitted range.
    """
    least, most = limits
    limit_text = f"{least:g} to {most:g} {unit}".rstrip()
    if measured is None:
        return ExpectationResult(name, False, missing_text, limit_text)

    distinct_values = dict.fromkeys(measured)  # a single value is printed once
    text = " to ".join(f"{value:.4g}" for value in distinct_values)

    distance_to_lower = measured.least - least
    distance_to_upper = most - measured.most
    distance = min(distance_to_lower, distance_to_upper)
    half_width = 0.5 * (most - least)
    is_single_value = measured.least == measured.most
    return ExpectationResult(
        key=name,
        held=distance >= 0.0,
        measured=f"{text} {unit}".rstrip(),
        limit=limit_text,
        margin=distance / half_width if half_width else None,
        value=measured.most if is_single_value else None,
    )
