"""Holds what was measured against what was expected.

Law: a pure function of figures and expectation; every outcome says what was measured, the limit, and the
margin, whether it held or not.
"""

from collections.abc import Callable, Iterator

import msgspec

from ..analysis.envelope import Trend
from ..scenario import Expect
from ..scenario.window import Window
from .figures import Figures
from .stretch import Span


class Outcome(msgspec.Struct, frozen=True):
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


def judge(expect: Expect, figures: Figures) -> list[Outcome]:
    """Returns an outcome for everything that is asked of a run, in the order of the keys of `Expect`.

    A run that diverged has an outcome `stable` even where that key is absent, see `Expect`.
    """
    return [
        *_stability(expect, figures),
        *_limits(expect, figures),
        *_poses(expect, figures),
        *_gaps(expect, figures),
        *_windows(expect, figures),
    ]


def _stability(expect: Expect, figures: Figures) -> Iterator[Outcome]:
    wanted = expect.stable
    diverged = figures.diverged_at_s is not None
    if wanted is None and not diverged:
        return
    if diverged:
        found: bool | None = False
        text = f"diverged at {figures.diverged_at_s:.4g} s"
    else:
        found = None if figures.trend is Trend.UNDECIDED else figures.trend is not Trend.GROWS
        rate = figures.rate_per_s
        text = figures.trend.value + ("" if rate is None or found is None else f", {rate:+.3g}/s")
    yield Outcome(
        "stable", found is not None and found is (wanted is not False), text, _word(wanted is not False)
    )


def _word(flag: bool) -> str:
    return "true" if flag else "false"


_Reading = Callable[[Figures], float | None]

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


def _limits(expect: Expect, figures: Figures) -> Iterator[Outcome]:
    for key, (reading, unit) in _READINGS.items():
        limit = getattr(expect, key)
        if limit is not None:
            yield _against(key, reading(figures), limit, unit)


def _against(key: str, measured: float | None, limit: float, unit: str) -> Outcome:
    least = "_min_" in key
    sign = "≥" if least else "≤"
    wanted = f"{sign} {limit:g} {unit}".rstrip()
    if measured is None:
        return Outcome(key, False, "never", wanted)
    spare = measured - limit if least else limit - measured
    return Outcome(
        key, spare >= 0.0, f"{measured:.4g} {unit}".rstrip(), wanted, spare / limit if limit else None
    )


def _poses(expect: Expect, figures: Figures) -> Iterator[Outcome]:
    within = expect.end_pose_within_rad
    for site, wanted in expect.end_pose_rad.items():
        text = f"({', '.join(f'{angle:g}' for angle in wanted)}) ± {within:g} rad"
        reached = figures.end_pose_rad.get(site)
        if reached is None:
            yield Outcome(f"end_pose_rad.{site}", False, "never", text)
            continue
        off = max(abs(a - b) for a, b in zip(reached, wanted, strict=True))
        yield Outcome(
            f"end_pose_rad.{site}",
            off <= within,
            f"({', '.join(f'{angle:.4f}' for angle in reached)}) rad",
            text,
            (within - off) / within,
        )


def _gaps(expect: Expect, figures: Figures) -> Iterator[Outcome]:
    if expect.no_gaps:
        yield Outcome("no_gaps", figures.missing == 0, f"{figures.missing} missing", "0 missing")


def _windows(expect: Expect, figures: Figures) -> Iterator[Outcome]:
    for window, spans in zip(expect.windows, figures.windows, strict=True):
        for key, (least, most) in window.asked:
            yield _within(_called(key, window), spans.get(key), least, most, _unit(key))


def _unit(key: str) -> str:
    """Returns the unit that a quantity of a window ends in, for people."""
    units = {"_rad_s": "rad/s", "_rad": "rad", "_nm": "N m", "_n": "N"}
    return next((word for ending, word in units.items() if key.endswith(ending)), "")


def _called(key: str, window: Window) -> str:
    """Returns how a quantity of a window is called, as in `wall_mean_n s 9-15 s`."""
    site = f" {window.site}" if window.site else ""
    return f"{key}{site} {window.from_s:g}-{window.to_s:g} s"


def _within(key: str, span: Span | None, least: float, most: float, unit: str) -> Outcome:
    wanted = f"{least:g} to {most:g} {unit}".rstrip()
    if span is None:
        return Outcome(key, False, "never", wanted)
    text = f"{span.least:.4g}" if span.least == span.most else f"{span.least:.4g} to {span.most:.4g}"
    spare, half = min(span.least - least, most - span.most), 0.5 * (most - least)
    return Outcome(key, spare >= 0.0, f"{text} {unit}".rstrip(), wanted, spare / half if half else None)
