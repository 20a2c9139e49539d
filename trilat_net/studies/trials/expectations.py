"""Evaluates [expect] on the metrics of a run.

Invariant: a pure function of metrics and expectation; every result states the measured value, the limit and
the margin, held or not.
"""

from collections.abc import Callable, Iterator

import msgspec

from ...scenario import Expect
from .measure_run import RunMetrics
from .site_stats import Range


class ExpectationResult(msgspec.Struct, frozen=True):
    """One thing that was expected of one run.

    Attributes:
        key: the key of [expect] that asked, or a word for what every run must do.
        held: whether it is so.
        measured: what was measured, in words with its unit.
        limit: what was asked, in words with its unit.
        margin: how far within the limit, as a fraction of the limit: 0.1 is 10 % to spare, negative is
            beyond it. None where there is no such number.
    """

    key: str
    held: bool
    measured: str
    limit: str
    margin: float | None = None


def evaluate_expectations(expect: Expect, figures: RunMetrics) -> list[ExpectationResult]:
    """Returns an outcome for everything that is asked of a run, in the order of the keys of `Expect`.

    A run that diverged has an outcome `stable` even where that key is absent, see `Expect`.
    """
    missing = f"{figures.missing} missing"
    gaps = ExpectationResult("no_gaps", figures.missing == 0, missing, "0 missing")
    return [
        *_stability(expect, figures),
        *_limits(expect, figures),
        *_poses(expect, figures),
        *([gaps] if expect.no_gaps else []),
        *_windows(expect, figures),
    ]


def _stability(expect: Expect, figures: RunMetrics) -> Iterator[ExpectationResult]:
    wanted = expect.stable is not False
    diverged = figures.diverged_at_s is not None
    if expect.stable is None and not diverged:
        return
    if diverged:
        found: bool | None = False
        text = f"diverged at {figures.diverged_at_s:.4g} s"
    else:
        found = None if figures.trend.grows is None else not figures.trend.grows
        rate = figures.rate_per_s
        text = figures.trend.value + ("" if rate is None or found is None else f", {rate:+.3g}/s")
    yield ExpectationResult("stable", found is wanted, text, "true" if wanted else "false")


_UNITS = {"_rad_s": "rad/s", "_rad": "rad", "_nm": "N m", "_n": "N"}
"""Per ending of a key its unit, for people."""

_Reading = Callable[[RunMetrics], float | None]

_READINGS: dict[str, tuple[_Reading, str]] = {
    "synchronised_by_s": (lambda f: f.synchronised_at_s, "s"),
    "peak_error_max_rad": (lambda f: f.peak_error_rad, "rad"),
    "peak_error_min_rad": (lambda f: f.peak_error_rad, "rad"),
    "rms_error_max_rad": (lambda f: f.rms_error_rad, "rad"),
    "end_error_max_rad": (lambda f: f.end_error_rad, "rad"),
    "end_error_min_rad": (lambda f: f.end_error_rad, "rad"),
    "end_spread_max_rad": (lambda f: f.end_spread_rad, "rad"),
    "peak_torque_max_nm": (lambda f: f.peak_torque_nm, "N m"),
    "peak_speed_max_rad_s": (lambda f: f.peak_speed_rad_s, "rad/s"),
    "age_max_ms": (lambda f: _over_links([age.max_ms for age in f.ages.values()], max), "ms"),
    "mean_age_max_ms": (lambda f: _over_links([age.mean_ms for age in f.ages.values()], max), "ms"),
    "mean_age_min_ms": (lambda f: _over_links([age.mean_ms for age in f.ages.values()], min), "ms"),
    "late_samples_max": (lambda f: float(f.late_samples), ""),
}


def _over_links(values: list[float | None], choice: Callable[[list[float]], float]) -> float | None:
    """Returns the largest or smallest of the links; None where a link never had a sample."""
    known = [value for value in values if value is not None]
    return choice(known) if known and len(known) == len(values) else None


def _limits(expect: Expect, figures: RunMetrics) -> Iterator[ExpectationResult]:
    for key, (reading, unit) in _READINGS.items():
        limit = getattr(expect, key)
        if limit is not None:
            yield _against(key, reading(figures), limit, unit)


def _against(key: str, measured: float | None, limit: float, unit: str) -> ExpectationResult:
    least = "_min_" in key
    sign = "≥" if least else "≤"
    wanted = f"{sign} {limit:g} {unit}".rstrip()
    if measured is None:
        return ExpectationResult(key, False, "never", wanted)
    spare = measured - limit if least else limit - measured
    return ExpectationResult(
        key, spare >= 0.0, f"{measured:.4g} {unit}".rstrip(), wanted, spare / limit if limit else None
    )


def _poses(expect: Expect, figures: RunMetrics) -> Iterator[ExpectationResult]:
    within = expect.end_pose_within_rad
    for site, wanted in expect.end_pose_rad.items():
        text = f"({', '.join(f'{angle:g}' for angle in wanted)}) ± {within:g} rad"
        reached = figures.end_pose_rad.get(site)
        if reached is None:
            yield ExpectationResult(f"end_pose_rad.{site}", False, "never", text)
            continue
        off = max(abs(a - b) for a, b in zip(reached, wanted, strict=True))
        yield ExpectationResult(
            f"end_pose_rad.{site}",
            off <= within,
            f"({', '.join(f'{angle:.4f}' for angle in reached)}) rad",
            text,
            (within - off) / within,
        )


def _windows(expect: Expect, figures: RunMetrics) -> Iterator[ExpectationResult]:
    for window, spans in zip(expect.windows, figures.windows, strict=True):
        for key, (least, most) in window.asked:
            site = f" {window.site}" if window.site else ""
            name = f"{key}{site} {window.from_s:g}-{window.to_s:g} s"  # as in wall_mean_n s 9-15 s
            unit = next((word for ending, word in _UNITS.items() if key.endswith(ending)), "")
            yield _within(name, spans.get(key), least, most, unit)


def _within(key: str, span: Range | None, least: float, most: float, unit: str) -> ExpectationResult:
    wanted = f"{least:g} to {most:g} {unit}".rstrip()
    if span is None:
        return ExpectationResult(key, False, "never", wanted)
    text = f"{span.least:.4g}" if span.least == span.most else f"{span.least:.4g} to {span.most:.4g}"
    spare, half = min(span.least - least, most - span.most), 0.5 * (most - least)
    return ExpectationResult(
        key, spare >= 0.0, f"{text} {unit}".rstrip(), wanted, spare / half if half else None
    )
