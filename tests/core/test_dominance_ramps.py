"""Changing shares are functions of time and of the ramps alone, and rows keep their sum."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.core.builders import make_site_setup, step_site
from trilat_net.core.links.dominance import apply_ramps, fold_ramps
from trilat_net.core.links.link import link_dtype
from trilat_net.core.step.site_setup import LinkSetup
from trilat_net.core.step.site_step import MAX_RAMPS, Site
from trilat_net.core.step.ticks import Arrival, CoreChange, DominanceRamp, TickInput, TickRecord

S = 10**9
PEERS = 3
ULP = 2.0**-52
Row = tuple[float, ...]
Ramps = list[DominanceRamp]


@st.composite
def draw_row(draw: st.DrawFn) -> Row:
    """Draws shares that sum to 1 as closely as doubles do."""
    parts = draw(st.lists(st.integers(0, 10**6), min_size=PEERS, max_size=PEERS))
    assume(sum(parts) > 0)
    return tuple(part / sum(parts) for part in parts)


@st.composite
def ramp_lists(draw: st.DrawFn) -> Ramps:
    """Draws up to six ramps in the order of their starts; they may overlap, touch, take no
    time, or begin at 0.
    """
    starts = sorted(draw(st.lists(st.integers(0, 10 * S), max_size=6)))
    lasts = st.one_of(st.just(0), st.integers(1, 5 * S))
    return [DominanceRamp(start, start + draw(lasts), draw(draw_row())) for start in starts]


def make_share_table(first: Row, ramps: Ramps) -> np.ndarray:
    return np.array(
        [(0, 0, *first), *((r.start_ns, r.end_ns, *r.alpha) for r in ramps)], dtype=np.float64
    )


def compute_shares(t_ns: int, first: Row, ramps: Ramps) -> tuple[list[float], list[float]]:
    """Returns (alpha, its derivative) per peer."""
    links = np.zeros(PEERS, link_dtype(2))
    apply_ramps(t_ns, 1 + len(ramps), make_share_table(first, ramps), links)
    return links["alpha"].tolist(), links["alpha_rate"].tolist()


def compute_exact_shares(t_ns: int, first: Row, ramps: Ramps) -> list[Fraction]:
    """Returns the same in fractions: each ramp leads from the value of the earlier ramps to its own end."""
    if not ramps or t_ns < ramps[0].start_ns:
        return [Fraction(a) for a in first]
    last = max(n for n, ramp in enumerate(ramps) if ramp.start_ns <= t_ns)
    start_ns, end_ns, after = ramps[last]
    if t_ns >= end_ns:
        return [Fraction(a) for a in after]
    before = first if last == 0 else compute_exact_shares(start_ns, first, ramps[:last])
    done = Fraction(t_ns - start_ns, end_ns - start_ns)
    return [
        b + (Fraction(a) - b) * done for a, b in zip(after, map(Fraction, before), strict=True)
    ]


times = st.integers(0, 16 * S)


@given(first=draw_row(), ramps=ramp_lists(), t_ns=times)
def test_shares_are_those_of_the_ramps(first: Row, ramps: Ramps, t_ns: int) -> None:
    alpha, _ = compute_shares(t_ns, first, ramps)
    assert alpha == pytest.approx(
        [float(a) for a in compute_exact_shares(t_ns, first, ramps)], abs=1e-14
    )


@given(first=draw_row(), ramps=ramp_lists(), t_ns=times)
def test_a_row_sums_to_one_at_all_times(first: Row, ramps: Ramps, t_ns: int) -> None:
    """Within two units in the last place, plus the error of the given rows."""
    alpha, rates = compute_shares(t_ns, first, ramps)
    off = max(abs(math.fsum(row) - 1.0) for row in (first, *(ramp.alpha for ramp in ramps)))
    assert abs(math.fsum(alpha) - 1.0) <= 2 * ULP + off
    assert all(-ULP <= a <= 1.0 + ULP for a in alpha)
    lasting_s = [
        (ramp.end_ns - ramp.start_ns) * 1e-9
        for ramp in ramps
        if ramp.start_ns <= t_ns < ramp.end_ns
    ]
    assert abs(math.fsum(rates)) <= (4 * ULP + 2 * off) / min(lasting_s, default=1.0)


@given(first=draw_row(), ramps=ramp_lists(), t_ns=times)
def test_the_derivative_is_the_finite_difference(first: Row, ramps: Ramps, t_ns: int) -> None:
    step_ns = 1000
    edges = [edge for ramp in ramps for edge in (ramp.start_ns, ramp.end_ns)]
    assume(not any(t_ns < edge <= t_ns + step_ns for edge in edges))
    share, rates = compute_shares(t_ns, first, ramps)
    later_share, _ = compute_shares(t_ns + step_ns, first, ramps)
    for a, b, rate in zip(share, later_share, rates, strict=True):
        assert (b - a) / (step_ns * 1e-9) == pytest.approx(rate, rel=1e-6, abs=1e-9)


# In a site.


def make_ramped_site(ramps: tuple[DominanceRamp, ...] = ()) -> Site:
    """Returns a site that follows a peer at rest at (1, -1) and one that moves at (0.5, 0) rad/s."""
    links = (LinkSetup("a", 0.9, 1000, (1.0, -1.0)), LinkSetup("b", 0.1, 1000, (0.0, 0.0)))
    return Site(make_site_setup()._replace(links=links, ramps=ramps))


def make_moving_arrival(k: int) -> Arrival:
    return Arrival(1, k - 1, (0.5e-3 * (k - 1), 0.0), (0.5, 0.0))


def run_site(made: Site, commands: dict[int, list[CoreChange]]) -> list[TickRecord]:
    return step_site(
        made,
        [
            TickInput(k, [make_moving_arrival(k)] if k else [], commands.get(k, []))
            for k in range(3000)
        ],
    )


def test_references_follow_changing_shares() -> None:
    """Eq. (6) with shares that change: the derivative contains their rates."""
    outputs = run_site(make_ramped_site((DominanceRamp(S, 2 * S, (0.1, 0.9)),)), {})
    q, qd = (np.array([getattr(o, field) for o in outputs]) for field in ("q_des", "qd_des"))
    t_s = np.arange(3000) / 1000
    a = np.clip(0.9 - 0.8 * (t_s - 1), 0.1, 0.9)
    b_at = np.maximum(0.5e-3 * (np.arange(3000) - 1), 0.0)
    assert np.allclose(q[:, 0], a + (1 - a) * b_at, atol=1e-12)
    assert np.allclose(q[:, 1], -a, atol=1e-12)
    central = (q[2:] - q[:-2]) / 2e-3
    inside = np.r_[1005:1995, 2005:2900]
    assert np.abs(central[inside - 1] - qd[inside]).max() < 1e-3


def test_earlier_commands_precede_planned_ramps() -> None:
    """Later ramps of the scenario still take place."""
    planned = DominanceRamp(2 * S, 2 * S, (0.0, 1.0))
    sooner = DominanceRamp(S, S, (0.5, 0.5))
    outputs = run_site(make_ramped_site((planned,)), {500: [CoreChange("shares", ramp=sooner)]})
    assert [outputs[k].q_des[1] for k in (999, 1000, 1999, 2000)] == [-0.9, -0.5, -0.5, 0.0]


def test_more_commands_than_a_run_takes_are_refused() -> None:
    site_of_run = make_ramped_site()
    for n in range(MAX_RAMPS):
        site_of_run.apply_change(CoreChange(str(n), ramp=DominanceRamp(n, n, (0.5, 0.5))), 0)
    with pytest.raises(ValueError, match="256"):
        site_of_run.apply_change(
            CoreChange("one more", ramp=DominanceRamp(S, S, (0.5, 0.5))), 0
        )


def test_each_ramp_begins_where_the_last_was() -> None:
    """Finished ramps are folded into one row: the same bits as of a site that keeps all of them."""
    ramps = []
    for n in range(MAX_RAMPS + 50):
        start_ns = (7 * n + 100) * 1_000_000
        share = 0.5 + 0.4 * math.sin(0.1 * n)
        ramps.append(DominanceRamp(start_ns, start_ns + 500_000_000, (share, 1.0 - share)))
    orders = {7 * n: [CoreChange("", ramp=ramp)] for n, ramp in enumerate(ramps)}
    commanded = run_site(make_ramped_site(), orders)
    assert [o._replace(cmd=[]) for o in commanded] == run_site(
        make_ramped_site(tuple(ramps)), {}
    )
    assert 7 * len(orders) < 3000


@given(draw_row(), ramp_lists(), st.integers(0, 12 * S), st.integers(0, 12 * S))
def test_folded_ramps_keep_the_bits(first: Row, ramps: Ramps, t: int, later: int) -> None:
    folded = make_share_table(first, ramps)
    count = fold_ramps(min(t, later), 1 + len(ramps), folded)
    links = np.zeros(PEERS, link_dtype(2))
    apply_ramps(max(t, later), count, folded, links)
    assert (links["alpha"].tolist(), links["alpha_rate"].tolist()) == compute_shares(
        max(t, later), first, ramps
    )
