"""The metrics of a run that [expect] can ask for, from a run in virtual time or from a log.

Invariant: every metric has one definition, and both sources feed the same statistics with the same records;
a metric that a run cannot give is None, never a guess.
"""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from ...analysis.run_end import EnvelopeFit, EnvelopeTrend, fit_envelope
from ...core.ticks import NS_PER_S
from ...core.vectors import Array
from ...execution.virtual_comparison import find_late_samples
from ...log.log_reader import Log
from ...scenario import Expect, Scenario
from ...scenario.expect import ALL_SITES_QUANTITIES
from ..record_batches import RecordBatch, run_in_batches
from .site_stats import BUCKET_NS, Range, SiteStats, WindowStats


class LinkAge(msgspec.Struct, frozen=True):
    """How old the sample in use was on one link; of a link that never had one both are None.

    Attributes:
        mean_ms: averaged over the receiver's ticks from the first sample on, ms.
        max_ms: the largest, ms.
    """

    mean_ms: float | None
    max_ms: float | None


class RunMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """One run, measured; the docstring of `Expect` defines every figure.

    Attributes:
        simulated_s: how much time of the experiment ran.
        diverged_at_s: when the first site left its limits; None where none did.
        trend: what the envelope of the largest |e| does at the end.
        rate_per_s: its rate, 1/s; None where the run is too short for one.
        synchronised_at_s: since when the largest |e| is below `synchronised_rad`; None where it is not.
        peak_error_rad: largest |e|.
        rms_error_rad: root mean square of e, of the worst joint.
        end_error_rad: largest |e| of the last second.
        end_spread_rad: largest difference between sites in the last second.
        end_pose_rad: joint angles of every site's last tick.
        peak_torque_nm: largest control torque.
        peak_speed_rad_s: largest joint speed.
        ages: per link "j->i".
        late_samples: samples that came too late for what their link meant to do with them.
        missing: ticks without a record.
        windows: per window of [expect] its quantities by their keys; none where the run ended before it did.
    """

    simulated_s: float
    diverged_at_s: float | None
    trend: EnvelopeTrend
    rate_per_s: float | None
    synchronised_at_s: float | None
    peak_error_rad: float | None
    rms_error_rad: float | None
    end_error_rad: float | None
    end_spread_rad: float | None
    end_pose_rad: dict[str, tuple[float, ...]]
    peak_torque_nm: float | None
    peak_speed_rad_s: float | None
    ages: dict[str, LinkAge]
    late_samples: int
    missing: int
    windows: tuple[dict[str, Range], ...] = ()


def compute_run_metrics(
    scenario: Scenario,
    tallies: Mapping[str, SiteStats],
    *,
    diverged_at_s: float | None,
    late_samples: int,
    missing: int,
) -> RunMetrics:
    """Returns the metrics of a run from the statistics of its sites, in scenario order."""
    ran = {name: tally for name, tally in tallies.items() if tally.records}
    whole = len(ran) == len(tallies)
    end_ns = max((tally.last_ns for tally in ran.values()), default=0)
    trend = _envelope(ran)
    span_s = [tally.last_ns / NS_PER_S + 1.0 / scenario.sites[name].rate_hz for name, tally in ran.items()]
    apart_ns = [tally.apart_ns for tally in ran.values()]
    synchronised = whole and not any(tally.apart_ns == tally.last_ns for tally in ran.values())
    ends = {name: tally.end(end_ns) for name, tally in ran.items()}

    def largest(name: str) -> float | None:
        return max((getattr(tally, name) for tally in ran.values()), default=None)

    return RunMetrics(
        simulated_s=max(span_s, default=0.0),  # to the end of the period that follows the last tick
        diverged_at_s=diverged_at_s,
        trend=trend.trend,
        rate_per_s=None if np.isnan(trend.rate_per_s) else trend.rate_per_s,
        synchronised_at_s=max(0, *apart_ns) / NS_PER_S if synchronised else None,
        peak_error_rad=largest("peak_error_rad"),
        rms_error_rad=largest("rms_error_rad"),
        end_error_rad=max(
            (float(np.abs(end.q - end.q_des).max(initial=0.0)) for end in ends.values()), default=None
        ),
        end_spread_rad=_end_spread_rad(list(ends.values())) if whole else None,
        end_pose_rad={name: tuple(tally.end(tally.last_ns).q[-1].tolist()) for name, tally in ran.items()},
        peak_torque_nm=largest("peak_torque_nm"),
        peak_speed_rad_s=largest("peak_speed_rad_s"),
        ages=_link_ages(scenario, tallies),
        late_samples=late_samples,
        missing=missing,
        windows=tuple(
            _window_ranges([t.stretches[n] for t in tallies.values()])
            for n in range(len(scenario.expect.windows))
        ),
    )


def _link_ages(scenario: Scenario, tallies: Mapping[str, SiteStats]) -> dict[str, LinkAge]:
    return {
        f"{peer}->{name}": LinkAge(mean_ms, None if mean_ms is None else float(max_ms))
        for name, tally in tallies.items()
        for peer, mean_ms, max_ms in zip(
            scenario.peers(name), tally.mean_age_ms, tally.age_max_ms, strict=True
        )
    }


def _window_ranges(stretches: Sequence[WindowStats | None]) -> dict[str, Range]:
    """Returns the quantities of a window, of all sites that it is of."""
    parts = [stretch.figures() for stretch in stretches if stretch is not None]
    if len(parts) == 1:
        return parts[0]
    known = set.intersection(*map(set, parts)) & set(ALL_SITES_QUANTITIES)
    return {
        key: Range(*(max(part[key][n] for part in parts) for n in (0, 1)))
        for key in ALL_SITES_QUANTITIES
        if key in known
    }


def _envelope(ran: Mapping[str, SiteStats]) -> EnvelopeFit:
    """Returns the trend of the largest |e| of all sites; a site's last, unfinished bucket is left out."""
    parts = [tally.peaks() for tally in ran.values()]
    count = min(map(len, parts), default=0)
    largest = np.max(np.reshape([part[:count] for part in parts], (len(parts), count)), axis=0, initial=-1.0)
    kept = np.flatnonzero(largest >= 0.0)
    t_s: Array = kept.astype(np.float64) * (BUCKET_NS / NS_PER_S)
    return fit_envelope(t_s, largest[kept].astype(np.float64))


def _end_spread_rad(ends: Sequence[RecordBatch]) -> float | None:
    """Compares every site's latest angles at the ticks of the first one, in their last second."""
    if not all(len(end.t_ns) for end in ends):  # a site's part ends long before the others'
        return None
    at_ns = ends[0].t_ns[ends[0].t_ns >= max(end.t_ns[0] for end in ends)]
    poses: Array = np.array([end.q[np.searchsorted(end.t_ns, at_ns, side="right") - 1] for end in ends])
    return float((poses.max(axis=0) - poses.min(axis=0)).max(initial=0.0))


def measure_virtual_run(scenario: Scenario) -> RunMetrics:
    """Runs a scenario in virtual time and returns its metrics."""
    tallies = {name: _site_stats(scenario, name) for name in scenario.names}
    run = run_in_batches(scenario, {name: tally.add for name, tally in tallies.items()})
    made = sum(tally.records for tally in tallies.values())
    return compute_run_metrics(
        scenario,
        tallies,
        diverged_at_s=run.diverged_at_s,
        late_samples=run.late_samples,
        missing=0 if run.diverged_at_s is not None else sum(map(scenario.ticks, scenario.names)) - made,
    )


def measure_log(log: Log, expect: Expect | None = None) -> RunMetrics:
    """Returns the metrics of a log.

    Raises:
        LogError: a record cannot be read.
    """
    scenario = log.scenario if expect is None else msgspec.structs.replace(log.scenario, expect=expect)
    made = {event.member: event.ticks for event in log.events if event.kind == "end"}
    last = [log[name].record(-1) for name in log.sites if len(log[name])]
    diverged_ns = [state.t_ns for state in last if state.mode == "diverged"]
    tallies = {name: _site_stats(scenario, name) for name in log.sites}
    missing = 0
    for name, tally in tallies.items():
        part = log[name]
        used = np.array([part.used[peer] for peer in part.peers]).T
        tally.add(RecordBatch(part.t_ns, part.q, part.qd, part.q_des, part.tau, part.tau_x, used))
        wanted = made.get(name, 0) if diverged_ns else scenario.ticks(name)
        missing += max(0, wanted - len(part))
    return compute_run_metrics(
        scenario,
        tallies,
        diverged_at_s=min(diverged_ns) / NS_PER_S if diverged_ns else None,
        late_samples=len(find_late_samples(log)),
        missing=missing,
    )


def _site_stats(scenario: Scenario, site: str) -> SiteStats:
    peer_rates = [scenario.sites[peer].rate_hz for peer in scenario.peers(site)]
    stretches = [
        WindowStats(window, scenario.sites[site]) if window.site in ("", site) else None
        for window in scenario.expect.windows
    ]
    return SiteStats(peer_rates, scenario.expect.synchronised_rad, stretches)
