"""Evaluates [expect] on the metrics of a run.

Invariant: a pure function of metrics and expectation; every result states the measured value, the limit and
the margin, held or not.
"""

from collections.abc import Callable, Iterator
from operator import attrgetter

import msgspec

from ...analysis.run_end import Stability
from ...scenario import Expect
from .measure_run import RunMetrics


class ExpectationResult(msgspec.Struct, frozen=True):
    """One thing that was expected of one run; values in words with their units.

    Attributes:
        key: the key of [expect] that asked, or a word for what every run must do.
        margin: how far within the limit, as a fraction of the limit: 0.1 is 10 % to spare, negative is
            beyond it. None where there is no such number.
        value: the measured number, in the unit of the limit; None where it is none.
    """

    key: str
    held: bool
    measured: str
    limit: str
    margin: float | None = None
    value: float | None = None


def evaluate_expectations(expect: Expect, metrics: RunMetrics) -> list[ExpectationResult]:
    """Returns an outcome for everything that is asked of a run, in the order of the keys of `Expect`.

    A run that diverged has an outcome `stable` even where that key is absent, see `Expect`.
    """
    limits = [
        _compare_with_limit(key, read(metrics), getattr(expect, key), unit)
        for key, (read, unit) in _READINGS.items()
        if getattr(expect, key) is not None
    ]
    missing = f"{metrics.missing} missing"
    gaps = ExpectationResult("no_gaps", metrics.missing == 0, missing, "0 missing")
    return [
        *_evaluate_stability(expect, metrics),
        *limits,
        *_evaluate_poses(expect, metrics),
        *([gaps] if expect.no_gaps else []),
        *_evaluate_windows(expect, metrics),
    ]


def _evaluate_stability(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    wanted, end = expect.stable is not False, metrics.end
    if expect.stable is not None or end.diverged_at_s is not None:
        held = end.stability is (Stability.STABLE if wanted else Stability.NOT_STABLE)
        yield ExpectationResult("stable", held, f"{end.stability}: {end.text}", str(wanted).lower())


_UNITS = {"_rad_s": "rad/s", "_rad": "rad", "_nm": "N m", "_n": "N"}
"""Per ending of a key its unit, for people."""


def _read_ages(name: str, choose: Callable[[list[float]], float]) -> Callable[[RunMetrics], float | None]:
    """Returns the largest or smallest of the links; None where a link never had a sample."""

    def read(metrics: RunMetrics) -> float | None:
        known = [value for age in metrics.ages.values() if (value := getattr(age, name)) is not None]
        return choose(known) if known and len(known) == len(metrics.ages) else None

    return read


_READINGS: dict[str, tuple[Callable[[RunMetrics], float | None], str]] = {
    "synchronised_by_s": (attrgetter("synchronised_at_s"), "s"),
    "peak_error_max_rad": (attrgetter("peak_error_rad"), "rad"),
    "peak_error_min_rad": (attrgetter("peak_error_rad"), "rad"),
    "rms_error_max_rad": (attrgetter("rms_error_rad"), "rad"),
    "end_error_max_rad": (attrgetter("end_error_rad"), "rad"),
    "end_error_min_rad": (attrgetter("end_error_rad"), "rad"),
    "end_spread_max_rad": (attrgetter("end_spread_rad"), "rad"),
    "peak_torque_max_nm": (attrgetter("peak_torque_nm"), "N m"),
    "peak_speed_max_rad_s": (attrgetter("peak_speed_rad_s"), "rad/s"),
    "age_max_ms": (_read_ages("max_ms", max), "ms"),
    "mean_age_max_ms": (_read_ages("mean_ms", max), "ms"),
    "mean_age_min_ms": (_read_ages("mean_ms", min), "ms"),
    "late_samples_max": (attrgetter("late_samples"), ""),
}


def _compare_with_limit(key: str, measured: float | None, limit: float, unit: str) -> ExpectationResult:
    least = "_min_" in key
    wanted = f"{'≥' if least else '≤'} {limit:g} {unit}".rstrip()
    if measured is None:
        return ExpectationResult(key, False, "never", wanted)
    spare = measured - limit if least else limit - measured
    text = f"{measured:.4g} {unit}".rstrip()
    return ExpectationResult(key, spare >= 0.0, text, wanted, spare / limit if limit else None, measured)


def _evaluate_poses(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    within = expect.end_pose_within_rad
    for site, wanted in expect.end_pose_rad.items():
        key = f"end_pose_rad.{site}"
        limit = f"({', '.join(f'{angle:g}' for angle in wanted)}) ± {within:g} rad"
        reached = metrics.end_pose_rad.get(site)
        if reached is None:
            yield ExpectationResult(key, False, "never", limit)
            continue
        off = max(abs(a - b) for a, b in zip(reached, wanted, strict=True))
        text = f"({', '.join(f'{angle:.4f}' for angle in reached)}) rad"
        yield ExpectationResult(key, off <= within, text, limit, (within - off) / within)


def _evaluate_windows(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    for window, ranges in zip(expect.windows, metrics.windows, strict=True):
        for key, (least, most) in window.asked:
            site = f" {window.site}" if window.site else ""
            name = f"{key}{site} {window.from_s:g}-{window.to_s:g} s"  # as in wall_mean_n s 9-15 s
            unit = next((word for ending, word in _UNITS.items() if key.endswith(ending)), "")
            wanted = f"{least:g} to {most:g} {unit}".rstrip()
            found = ranges.get(key)
            if found is None:
                yield ExpectationResult(name, False, "never", wanted)
                continue
            text = " to ".join(f"{value:.4g}" for value in dict.fromkeys(found))
            spare, half = min(found.least - least, most - found.most), 0.5 * (most - least)
            margin = spare / half if half else None
            value = found.most if found.least == found.most else None
            yield ExpectationResult(name, spare >= 0.0, f"{text} {unit}".rstrip(), wanted, margin, value)
