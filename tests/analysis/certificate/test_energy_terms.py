"""Jumps are exact: each booked jump is the difference of V before and after, found by computing V twice."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.analysis.builders import make_run
from trilat_net.analysis.aligned import AlignedRecords, PeerTrajectory
from trilat_net.analysis.arm_rows import PlanarArmRows
from trilat_net.analysis.certificate.energy_terms import SiteConstants, SiteMotion
from trilat_net.analysis.dominance_history import DominanceHistory
from trilat_net.analysis.torque_sources import TorqueSplit

ROWS = 40
NOW = 30
RATE_HZ = 100
EQ = SiteConstants(
    arm=PlanarArmRows(np.array([3.0, 1.0, 1.0, 2.0, 1.0]), 9.81, (1.0, 1.0)),
    Lambda=np.array([1.0, 2.5]),
    Kp=np.array([0.5, 2.0]),
    Kd=np.array([3.0, 0.7]),
    Gamma=np.ones(5),
    low=np.full(5, -np.inf),
    high=np.full(5, np.inf),
    tau_limit=50.0,
)


def draw_records(
    random: np.random.Generator, site: str, used: dict[str, np.ndarray], rows: int, first: int
) -> AlignedRecords:
    vectors = [random.normal(size=(rows, 2)) for _ in range(6)]
    yes = np.ones(rows, dtype=np.bool_)
    return AlignedRecords(
        site, RATE_HZ, first, yes, yes, *vectors, random.normal(size=(rows, 5)), used
    )


class Situation:
    """A site at two ticks, its peers at all earlier times, and a choice of the samples in use."""

    def __init__(self, seed: int, before: tuple[int, int], after: tuple[int, int]) -> None:
        random = np.random.default_rng(seed)
        self.peers = [draw_records(random, name, {}, ROWS, 0) for name in ("a", "b")]
        self.alpha = random.dirichlet([1.0, 1.0])
        used = {
            name: np.array(pair)
            for name, pair in zip(("a", "b"), zip(before, after, strict=True), strict=True)
        }
        self.track = draw_records(random, "s", used, 2, NOW)
        self.views = [self.track.view_delayed_peer(PeerTrajectory(peer)) for peer in self.peers]
        self.track.q_des[:] = sum(
            a * v.delayed.q for a, v in zip(self.alpha, self.views, strict=True)
        )
        alpha = np.tile(self.alpha, (2, 1))
        self.shares = DominanceHistory(alpha, np.zeros((2, 2)), alpha[:1])

    @property
    def motion(self) -> SiteMotion:
        peers = dict(zip(("a", "b"), self.views, strict=True))
        none = np.zeros_like(self.track.q)
        tip = PlanarArmRows(np.zeros(5), 0.0, (1.0, 1.0)).place_end_effector(
            self.track.q, self.track.qd
        )
        return SiteMotion(
            self.track, EQ, self.shares, peers, TorqueSplit(tip, none, none, none, none)
        )

    def v(self, row: int) -> float:
        return float(self.motion.evaluate_functional().total[row])

    def booked(self) -> list[float]:
        return [float(self.motion.compute_link_work(j).total[0]) for j in range(2)]


ticks = st.integers(1, NOW - 2)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.tuples(ticks, ticks), st.tuples(ticks, ticks))
def test_jumps_of_links_change_v_exactly(
    seed: int, before: tuple[int, int], after: tuple[int, int]
) -> None:
    """Compared with the same instant whose samples in use are as old as those before: m + 1 in
    place of m'.
    """
    jumped = Situation(seed, before, after)
    situation = Situation(seed, before, (before[0] + 1, before[1] + 1))
    change = jumped.v(1) - situation.v(1)
    assert sum(jumped.booked()) == pytest.approx(change, rel=1e-9, abs=1e-9)
    assert situation.booked() == pytest.approx([0.0, 0.0], abs=1e-12)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.tuples(ticks, ticks), st.tuples(ticks, ticks))
def test_sample_ages_are_kept_within_a_period(
    seed: int, before: tuple[int, int], after: tuple[int, int]
) -> None:
    site = Situation(seed, before, after)
    ends = site.motion.ends
    kept = sum(a * p.q[m + 1] for a, p, m in zip(site.alpha, site.peers, before, strict=True))
    q = site.track.q[1]
    qd = site.track.qd[1]
    right = qd + EQ.Lambda * (q - kept)
    jumped = qd + EQ.Lambda * (q - site.track.q_des[1])
    assert ends.r_right[0] == pytest.approx(right)
    assert ends.r_middle[0] == pytest.approx(0.5 * (right + jumped))
    assert ends.qd_des_right[0] == pytest.approx(
        sum(a * p.qd[m + 1] for a, p, m in zip(site.alpha, site.peers, before, strict=True))
    )


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_a_held_torque_works_with_its_initial_value(seed: int) -> None:
    site = Situation(seed, (5, 9), (6, 10))
    ends = site.motion.ends
    now, held = np.random.default_rng(seed).normal(size=(2, 2, 2))
    booked = site.motion.compute_torque_work(now, held)
    left = ends.r_left[0] @ (now[0] + held[0])
    right = ends.r_right[0] @ (now[1] + held[0])
    assert float(booked.total[0]) == pytest.approx(0.5 / RATE_HZ * (left + right))


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_a_step_of_shares_changes_v_exactly(seed: int, share: float) -> None:
    stepped, kept = (Situation(seed, (5, 9), (6, 10)) for _ in range(2))
    after = np.array([share, 1.0 - share])
    stepped.shares.alpha[1] = after
    stepped.track.q_des[1] = sum(
        a * v.delayed.q[1] for a, v in zip(after, stepped.views, strict=True)
    )
    amount = stepped.motion.compute_dominance_work().total[0]
    assert float(amount) == pytest.approx(stepped.v(1) - kept.v(1), rel=1e-9, abs=1e-9)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_slow_delay_change_gives_the_missing_term(seed: int) -> None:
    """a_ij T' [ 1/2 |qd_jd|^2_Kd + (Lambda Kd e_i + Lambda M r_i)' qd_jd ], for an age that
    grows slowly.
    """
    site = Situation(seed, (5, 9), (6, 10))
    peer = site.peers[0]
    t_s = np.arange(ROWS) / RATE_HZ
    speed = np.array([0.3, -0.2])
    peer.qd[:] = speed
    peer.q[:] = speed * t_s[:, np.newaxis]
    peer = peer._replace(rate_hz=RATE_HZ)
    grown_s = 1e-6
    peer_view = site.track.view_delayed_peer(PeerTrajectory(peer))
    later = PeerTrajectory(peer).evaluate(peer_view.stamp_s - np.array([0.0, grown_s]))
    site.views[0] = peer_view._replace(delayed=later)
    site.track.q_des[1] = sum(
        a * v.delayed.q[1] for a, v in zip(site.alpha, site.views, strict=True)
    )
    booked = float(site.motion.compute_link_work(0).total[0])
    e = site.track.e[1]
    qd = site.track.qd[1]
    q = site.track.q[1]
    r = qd + EQ.Lambda * e
    c2 = np.cos(q[1])
    M = np.array([[3 + 2 * c2, 1 + c2], [1 + c2, 1.0]])
    missing = 0.5 * EQ.Kd @ speed**2 + (EQ.Lambda * EQ.Kd * e + EQ.Lambda * (M @ r)) @ speed
    assert booked == pytest.approx(
        float(site.alpha[0] * grown_s * missing), rel=1e-4, abs=1e-11
    )


def test_a_box_around_the_truth_only_dissipates() -> None:
    given_by_box = make_run("rich").balance.work["estimates"]
    assert given_by_box[-1] < -0.1
    assert np.diff(given_by_box).max() <= 1e-12


def test_the_torque_limit_counts_when_active() -> None:
    book = make_run("rich").energies["s"]
    cut = (np.abs(book.motion.records.tau) >= book.motion.constants.tau_limit).any(axis=1)
    booked = book.work["torque limit"]
    assert cut.any()
    assert np.array_equal(booked.left != 0.0, cut[:-1])
    assert np.array_equal(booked.right != 0.0, cut[1:])


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.tuples(ticks, ticks), st.tuples(ticks, ticks))
def test_sampling_work_ends_before_the_next_sample(
    seed: int, before: tuple[int, int], after: tuple[int, int]
) -> None:
    """The sampling work of a period does not depend on the sample that comes into use at its
    end.
    """
    booked = []
    for next_ticks in (after, (before[0] + 1, before[1] + 1)):
        site = Situation(seed, before, next_ticks)
        site.track.qd_des[:] = sum(
            a * v.delayed.qd for a, v in zip(site.alpha, site.views, strict=True)
        )
        law = site.motion.law_torque(np.arange(2))
        site.track.tau[1] = np.clip(law[1], -EQ.tau_limit, EQ.tau_limit)
        digital = dataclasses.replace(site.motion, scheme="digital")
        booked.append(float(digital.compute_sampling_work().total[0]))
    assert booked[0] == pytest.approx(booked[1], rel=1e-9, abs=1e-9)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 2, NOW]))
def test_a_torque_at_its_rate_limit_is_limited(seed: int, first: int) -> None:
    """A torque counts as limited where its change was cut to the rate, and the torque before a
    run is zero.
    """
    random = np.random.default_rng(seed)
    rate_nm_s = 60.0
    largest_nm = rate_nm_s / RATE_HZ
    demand = random.normal(scale=0.7, size=(ROWS, 2))
    track = draw_records(random, "s", {}, ROWS, first)
    previous = np.zeros(2)
    for row, demanded in enumerate(demand):
        track.tau[row] = np.clip(demanded, previous - largest_nm, previous + largest_nm)
        previous = track.tau[row]
    is_cut = track.tau != demand
    if first:
        is_cut[0] = False
    none = np.zeros_like(track.q)
    motion = SiteMotion(
        track,
        EQ._replace(tau_rate=np.array(rate_nm_s)),
        DominanceHistory(np.zeros((ROWS, 0)), np.zeros((ROWS, 0)), np.zeros((ROWS - 1, 0))),
        {},
        TorqueSplit(EQ.arm.place_end_effector(track.q, track.qd), none, none, none, none),
    )
    assert np.array_equal(motion.limited, is_cut)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
def test_wrong_fixed_estimates_do_work(seed: int, keeps: bool, rests: bool) -> None:
    """The work is that of r'Y(theta_hat - theta), over the parameters that are not adapted."""
    site = Situation(seed, (5, 9), (6, 10))
    theta = site.motion.constants.theta
    estimates = site.track.theta_hat
    estimates[:, 1] = theta[1]
    if keeps:
        estimates[1] = estimates[0]
    site.track = site.track._replace(rests=np.array([rests, rests]))
    adapts = np.array([1.0, 1.0, 0.0, 1.0, 0.0])
    motion = dataclasses.replace(site.motion, constants=EQ._replace(Gamma=adapts))
    booked = motion.compute_work()["estimates"]
    power = motion.Yr * (estimates - theta)
    is_fixed = np.tile(adapts == 0.0, (2, 1))
    is_fixed[1] |= keeps and rests
    expected = 0.5 / RATE_HZ * np.where(is_fixed, power, 0.0).sum(axis=1)
    assert float(booked.left[0]) == pytest.approx(expected[0], abs=1e-12)
    assert float(booked.right[0]) == pytest.approx(expected[1], abs=1e-12)
    assert float(booked.jump[0]) == 0.0
