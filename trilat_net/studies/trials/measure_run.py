"""The metrics of a run that [expect] can ask for, from a run in virtual time or from a log.

Invariant: every metric has one definition, and both sources feed the same statistics with the same records;
a metric that a run cannot give is None, never a guess.
"""

from array import array
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from ... import process
from ...analysis.run_end import EnvelopeFit, EnvelopeTrend, fit_envelope
from ...core.site_step import Site
from ...core.ticks import NS_PER_S, Mode, TickRecord
from ...core.two_link_arm import JOINTS
from ...core.vectors import Array
from ...execution import virtual
from ...execution.virtual_comparison import find_late_samples
from ...log.log_reader import Log
from ...scenario import Expect, Scenario
from ...scenario.expect import ALL_SITES_QUANTITIES
from .site_stats import BUCKET_NS, Range, RecordBatch, SiteStats, WindowStats


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
    """Returns the figures of a run.

    Args:
        scenario: the experiment.
        tallies: what was kept of every site, in scenario order.
        diverged_at_s: when the first site left its limits, s.
        late_samples: how many samples were late.
        missing: how many records are missing.
    """
    ran = {name: tally for name, tally in tallies.items() if tally.records}
    whole = len(ran) == len(tallies)
    end_ns = max((tally.last_ns for tally in ran.values()), default=0)
    trend = _envelope(ran)
    return RunMetrics(
        simulated_s=max((_span_s(scenario, name, tally) for name, tally in ran.items()), default=0.0),
        diverged_at_s=diverged_at_s,
        trend=trend.trend,
        rate_per_s=None if np.isnan(trend.rate_per_s) else trend.rate_per_s,
        synchronised_at_s=_synchronised_at_s(ran) if whole else None,
        peak_error_rad=_largest([tally.peak_error_rad for tally in ran.values()]),
        rms_error_rad=_largest([tally.rms_error_rad for tally in ran.values()]),
        end_error_rad=_largest([_end_error_rad(tally, end_ns) for tally in ran.values()]),
        end_spread_rad=_end_spread_rad(list(ran.values()), end_ns) if whole else None,
        end_pose_rad={name: tuple(tally.end(tally.last_ns).q[-1].tolist()) for name, tally in ran.items()},
        peak_torque_nm=_largest([tally.peak_torque_nm for tally in ran.values()]),
        peak_speed_rad_s=_largest([tally.peak_speed_rad_s for tally in ran.values()]),
        ages={
            f"{peer}->{name}": LinkAge(mean_ms, None if mean_ms is None else float(max_ms))
            for name, tally in tallies.items()
            for peer, mean_ms, max_ms in zip(
                scenario.peers(name), tally.mean_age_ms, tally.age_max_ms, strict=True
            )
        },
        late_samples=late_samples,
        missing=missing,
        windows=tuple(
            _window_ranges([t.stretches[n] for t in tallies.values()])
            for n in range(len(scenario.expect.windows))
        ),
    )


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


def _largest(values: list[float]) -> float | None:
    return max(values, default=None)


def _span_s(scenario: Scenario, name: str, tally: SiteStats) -> float:
    """Returns how long a site ran: to the end of the period that follows its last tick."""
    return tally.last_ns / NS_PER_S + 1.0 / scenario.sites[name].rate_hz


def _envelope(ran: Mapping[str, SiteStats]) -> EnvelopeFit:
    """Returns the trend of the largest |e| of all sites; a site's last, unfinished bucket is left out."""
    parts = [tally.peaks() for tally in ran.values()]
    count = min(map(len, parts), default=0)
    largest = np.max(np.reshape([part[:count] for part in parts], (len(parts), count)), axis=0, initial=-1.0)
    kept = np.flatnonzero(largest >= 0.0)
    t_s: Array = kept.astype(np.float64) * (BUCKET_NS / NS_PER_S)
    return fit_envelope(t_s, largest[kept].astype(np.float64))


def _synchronised_at_s(ran: Mapping[str, SiteStats]) -> float | None:
    if any(tally.apart_ns == tally.last_ns for tally in ran.values()):
        return None
    return max(0, *(tally.apart_ns for tally in ran.values())) / NS_PER_S


def _end_error_rad(tally: SiteStats, end_ns: int) -> float:
    end = tally.end(end_ns)
    return float(np.abs(end.q - end.q_des).max(initial=0.0))


def _end_spread_rad(tallies: list[SiteStats], end_ns: int) -> float | None:
    """Compares every site's latest angles at the ticks of the first one."""
    ends = [tally.end(end_ns) for tally in tallies]
    if not all(len(end.t_ns) for end in ends):  # a site's part ends long before the others'
        return None
    at_ns = ends[0].t_ns[ends[0].t_ns >= max(end.t_ns[0] for end in ends)]
    poses: Array = np.array([end.q[np.searchsorted(end.t_ns, at_ns, side="right") - 1] for end in ends])
    return float((poses.max(axis=0) - poses.min(axis=0)).max(initial=0.0))


BATCH_RECORDS = 1000
"""Records of a site that are collected before its statistics take them in."""


def measure_virtual_run(scenario: Scenario) -> RunMetrics:
    """Runs a scenario in virtual time and returns its figures."""
    held: dict[str, _PendingRecords] = {}
    diverged_at_s: float | None = None
    with process.pause_gc():
        for site, _, output in virtual.execute_virtual(scenario):
            if output.tick == 0:
                held[site.name] = _PendingRecords(site, _site_stats(scenario, site.name))
            held[site.name].take(output)
            if output.mode is Mode.DIVERGED and diverged_at_s is None:
                diverged_at_s = output.t_ns / NS_PER_S
    for part in held.values():
        part.flush()
    tallies = {name: part.tally for name, part in held.items()}
    made = sum(tally.records for tally in tallies.values())
    return compute_run_metrics(
        scenario,
        tallies,
        diverged_at_s=diverged_at_s,
        late_samples=sum(count.late for part in held.values() for count in part.site.counts()),
        missing=0 if diverged_at_s is not None else sum(map(scenario.ticks, scenario.names)) - made,
    )


def measure_log(log: Log, expect: Expect | None = None) -> RunMetrics:
    """Returns the figures of a log.

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


class _PendingRecords:
    """One site's records that its statistics have not taken in yet."""

    def __init__(self, site: Site, tally: SiteStats) -> None:
        self.site, self.tally = site, tally
        self._t_ns, self._used = array("q"), array("q")
        self._floats = array("d")

    def take(self, output: TickRecord) -> None:
        """Takes one record."""
        self._t_ns.append(output.t_ns)
        self._used.extend(output.used)
        floats = self._floats
        floats.extend(output.q)
        floats.extend(output.qd)
        floats.extend(output.q_des)
        floats.extend(output.tau)
        floats.extend(output.tau_x)
        if len(self._t_ns) >= BATCH_RECORDS:
            self.flush()

    def flush(self) -> None:
        """Passes the pending records on."""
        t_ns = np.array(self._t_ns, dtype=np.int64)
        used = np.array(self._used, dtype=np.int64).reshape(len(t_ns), len(self.site.peers))
        q, qd, q_des, tau, tau_x = np.array(self._floats).reshape(len(t_ns), 5, JOINTS).transpose(1, 0, 2)
        self.tally.add(RecordBatch(t_ns, q, qd, q_des, tau, tau_x, used))
        for held in (self._t_ns, self._used, self._floats):
            del held[:]
