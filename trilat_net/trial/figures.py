"""A finished run in the few numbers that an expectation can ask for.

Law: one definition of every figure, whatever drove the run; what a run cannot tell is None, never a guess.
"""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from ..analysis.envelope import Envelope, Trend, envelope
from ..core.arm import Array
from ..core.grid import NS_PER_S
from ..scenario import Scenario
from ..scenario.window import OF_ALL
from .stretch import Span, Stretch
from .tally import BUCKET_NS, Tally


class LinkAge(msgspec.Struct, frozen=True):
    """How old the sample in use was on one link; of a link that never had one both are None.

    Attributes:
        mean_ms: averaged over the receiver's ticks from the first sample on, ms.
        max_ms: the largest, ms.
    """

    mean_ms: float | None
    max_ms: float | None


class Figures(msgspec.Struct, frozen=True, kw_only=True):
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
    trend: Trend
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
    windows: tuple[dict[str, Span], ...] = ()


def measured(
    scenario: Scenario,
    tallies: Mapping[str, Tally],
    *,
    diverged_at_s: float | None,
    late_samples: int,
    missing: int,
) -> Figures:
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
    return Figures(
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
            _spans([t.stretches[n] for t in tallies.values()]) for n in range(len(scenario.expect.windows))
        ),
    )


def _spans(stretches: Sequence[Stretch | None]) -> dict[str, Span]:
    """Returns the quantities of a window, of all sites that it is of."""
    parts = [stretch.figures() for stretch in stretches if stretch is not None]
    if len(parts) == 1:
        return parts[0]
    known = set.intersection(*map(set, parts)) & set(OF_ALL)
    return {
        key: Span(*(max(part[key][n] for part in parts) for n in (0, 1))) for key in OF_ALL if key in known
    }


def _largest(values: list[float]) -> float | None:
    return max(values, default=None)


def _span_s(scenario: Scenario, name: str, tally: Tally) -> float:
    """Returns how long a site ran: to the end of the period that follows its last tick."""
    return tally.last_ns / NS_PER_S + 1.0 / scenario.sites[name].rate_hz


def _envelope(ran: Mapping[str, Tally]) -> Envelope:
    """Returns the trend of the largest |e| of all sites; a site's last, unfinished bucket is left out."""
    parts = [tally.peaks() for tally in ran.values()]
    count = min(map(len, parts), default=0)
    largest = np.max(np.reshape([part[:count] for part in parts], (len(parts), count)), axis=0, initial=-1.0)
    kept = np.flatnonzero(largest >= 0.0)
    t_s: Array = kept.astype(np.float64) * (BUCKET_NS / NS_PER_S)
    return envelope(t_s, largest[kept].astype(np.float64))


def _synchronised_at_s(ran: Mapping[str, Tally]) -> float | None:
    if any(tally.apart_ns == tally.last_ns for tally in ran.values()):
        return None
    return max(0, *(tally.apart_ns for tally in ran.values())) / NS_PER_S


def _end_error_rad(tally: Tally, end_ns: int) -> float:
    end = tally.end(end_ns)
    return float(np.abs(end.q - end.q_des).max(initial=0.0))


def _end_spread_rad(tallies: list[Tally], end_ns: int) -> float | None:
    """Compares every site's latest angles at the ticks of the first one."""
    ends = [tally.end(end_ns) for tally in tallies]
    if not all(len(end.t_ns) for end in ends):  # a site's part ends long before the others'
        return None
    at_ns = ends[0].t_ns[ends[0].t_ns >= max(end.t_ns[0] for end in ends)]
    poses: Array = np.array([end.q[np.searchsorted(end.t_ns, at_ns, side="right") - 1] for end in ends])
    return float((poses.max(axis=0) - poses.min(axis=0)).max(initial=0.0))
