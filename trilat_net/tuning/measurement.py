"""Runs a candidate in virtual time, without a log, and measures it.

Law: a score is a function of the scenario alone; where a run does not come to its end there is no error to
speak of, and it says so.
"""

from array import array
from typing import NamedTuple

import msgspec
import numpy as np

from .. import collector
from ..analysis.envelope import Trend, envelope
from ..analysis.quantities import SETTLED_RAD
from ..core.arm import JOINTS, Array
from ..core.grid import NS_PER_S
from ..core.tick import Mode, Output
from ..log.reader import Ints
from ..scenario import Scenario, parse
from ..scenario.site import SiteSpec
from ..sim import virtual
from .goal import consensus
from .outcome import END_S, Ending, Outcome, judged


class Score(msgspec.Struct, frozen=True):
    """One candidate, measured; the formulas stand in docs/fair-comparison.md.

    Attributes:
        outcome: what became of the run.
        error_rad: RMS distance of the arms from where they ought to be; None where the run diverged.
        spread_rad: the part of it that is the arms' distance from each other, at one instant, undelayed.
        pose_rad: the part of it that is the distance of their mean from the pose.
        effort_nm: RMS torque beyond what gravity asks at the pose where the arm is.
        settled_s: since when the largest |e| is below 0.01 rad; None where it is not at the end.
        saturated: share of all joint torques that were at the clamp.
        diverged_s: when the first site left its limits, or None.
    """

    outcome: Outcome
    error_rad: float | None
    spread_rad: float | None
    pose_rad: float | None
    effort_nm: float | None
    settled_s: float | None
    saturated: float
    diverged_s: float | None = None


def measure(text: str, twin_text: str | None) -> Score:
    """Runs a candidate and its twin, and returns its score.

    Args:
        text: the canonical text of its scenario.
        twin_text: of the twin on which its pose is judged; None where it is its own.
    """
    run = _run(parse(text))
    alone = run if twin_text is None else _run(parse(twin_text))
    diverged_s = run.diverged_s if run.diverged_s is not None else alone.diverged_s
    outcome = judged(diverged_s is not None, run.trend, run.ending, alone.ending)
    if diverged_s is not None:
        return Score(outcome, None, None, None, None, None, run.saturated, diverged_s)
    error_rad = float(np.hypot(run.spread_rad, alone.pose_rad))
    return Score(
        outcome, error_rad, run.spread_rad, alone.pose_rad, run.effort_nm, run.settled_s, run.saturated
    )


class _Run(NamedTuple):
    """What is measured of one run."""

    trend: Trend
    ending: Ending
    spread_rad: float
    pose_rad: float
    effort_nm: float
    settled_s: float | None
    saturated: float
    diverged_s: float | None


class _Record:
    """One site's run: time, ns, and q, q_des, tau of every tick."""

    def __init__(self, site: SiteSpec) -> None:
        self.site = site
        self._t_ns, self._floats = array("q"), array("d")

    def take(self, output: Output) -> None:
        """Takes one record."""
        self._t_ns.append(output.t_ns)
        self._floats.extend(output.q)
        self._floats.extend(output.q_des)
        self._floats.extend(output.tau)

    @property
    def t_ns(self) -> Ints:
        """Nominal times, shape (K,), ns."""
        return np.array(self._t_ns, dtype=np.int64)

    @property
    def rows(self) -> Array:
        """q, q_des and tau, shape (3, K, n)."""
        return np.array(self._floats).reshape(-1, 3, JOINTS).transpose(1, 0, 2)


def _run(scenario: Scenario) -> _Run:
    records = {name: _Record(spec) for name, spec in scenario.sites.items()}
    diverged_s: float | None = None
    with collector.paused():
        for site, _, output in virtual.run(scenario):
            records[site.name].take(output)
            if output.mode is Mode.DIVERGED and diverged_s is None:
                diverged_s = output.t_ns / NS_PER_S
    t_s, q, e = _aligned(list(records.values()))
    mean = q.mean(axis=0)
    apart, off = q - mean, mean - consensus(scenario, t_s)
    largest = np.abs(e).max(axis=(0, 2))
    efforts, saturated = zip(*map(_effort, records.values()), strict=True)
    return _Run(
        trend=envelope(t_s, largest).trend,
        ending=_ending(t_s, apart, off, e),
        spread_rad=_rms(apart),
        pose_rad=_rms(off),
        effort_nm=float(np.sqrt(np.mean(efforts))),
        settled_s=_settled_s(t_s, largest),
        saturated=float(np.mean(saturated)),
        diverged_s=diverged_s,
    )


def _aligned(records: list[_Record]) -> tuple[Array, Array, Array]:
    """Returns the ticks of the slowest site, s, and every site's latest q and e at them, shape (N, K, n)."""
    times = [record.t_ns for record in records]
    end_ns = min(t_ns[-1] for t_ns in times)
    slowest = min(times, key=len)
    at_ns = slowest[slowest <= end_ns]
    latest = [
        record.rows[:2, np.searchsorted(t_ns, at_ns, side="right") - 1]
        for record, t_ns in zip(records, times, strict=True)
    ]
    q, q_des = np.array(latest).transpose(1, 0, 2, 3)
    return at_ns / NS_PER_S, q, q - q_des


def _effort(record: _Record) -> tuple[float, float]:
    """Returns the mean square of tau - G(q), (N m)^2, and the share of torques at the clamp."""
    q, _, tau = record.rows
    arm = record.site.arm
    inner, outer = arm.g_m_s2 * arm.theta[3:, np.newaxis] * np.cos(np.cumsum(q, axis=1).T)
    gravity = np.array([inner + outer, outer]).T
    clamped = np.abs(tau) >= record.site.limits.tau_limit_nm
    return float(np.mean((tau - gravity) ** 2)), float(np.mean(clamped))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _settled_s(t_s: Array, largest: Array) -> float | None:
    apart = np.flatnonzero(largest >= SETTLED_RAD)
    if not len(apart):
        return 0.0
    return None if apart[-1] == len(t_s) - 1 else float(t_s[apart[-1]])


def _ending(t_s: Array, apart: Array, off: Array, e: Array) -> Ending:
    """Returns what the last second shows, and how the mean pose came there in the second half."""
    last = t_s > t_s[-1] - END_S
    half_s = 0.5 * t_s[-1]
    middle = (t_s > half_s - END_S) & (t_s <= half_s + 1e-9)
    end, before = (np.abs(off[part].mean(axis=0)) for part in (last, middle))
    return Ending(
        spread_rad=float(np.abs(apart[:, last]).max()),
        fall_rad=float(end.max()),
        ahead_rad=float((end + 2.0 * np.maximum(end - before, 0.0)).max()),
        swing_rad=float(np.ptp(e[:, last], axis=1).max()),
    )
