"""The work of the damping near singular poses, of end effectors whose samples jump."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenario.builders import planar_task_text
from trilat_net.analysis.aligned import AlignedRecords, PeerTrajectory
from trilat_net.analysis.certificate.energy_terms import SiteConstants, SiteMotion
from trilat_net.analysis.dominance_history import DominanceHistory
from trilat_net.analysis.following import build_following
from trilat_net.analysis.torque_sources import TorqueSplit
from trilat_net.scenario import parse_scenario

RATE_HZ = 100
ROWS = 20
NOW = 15
STEP_S = 1e-5
"""Time between two poses from which a derivative is computed, in s."""
CONSTANTS = SiteConstants.derive(
    parse_scenario(planar_task_text(), overrides={"task.singular_value": 0.9}), "s"
)


def draw_task_records(
    random: np.random.Generator, site: str, used: dict[str, np.ndarray], rows: int, first: int
) -> AlignedRecords:
    """Returns random records of a planar arm that is nearly stretched."""
    q = np.stack([random.normal(size=rows), random.uniform(0.1, 0.6, rows)], axis=1)
    qd = random.normal(size=(rows, 2))
    tip = CONSTANTS.arm.place_end_effector(q, qd)
    yes = np.ones(rows, dtype=np.bool_)
    return AlignedRecords(
        site=site,
        rate_hz=RATE_HZ,
        first=first,
        known=yes,
        follows=yes,
        q=q,
        qd=qd,
        q_des=random.normal(size=(rows, 3)),
        qd_des=random.normal(size=(rows, 3)),
        tau=random.normal(size=(rows, 2)),
        tau_x=np.zeros((rows, 2)),
        theta_hat=random.normal(size=(rows, len(CONSTANTS.theta))),
        used=used,
        x=tip.position,
        xd=tip.speed,
        axes=CONSTANTS.axes,
    )


def find_damping_power(q: np.ndarray, qd: np.ndarray, e: np.ndarray, ed: np.ndarray) -> float:
    """Returns r'M(a - dv/dt) - (J r - xd - Lambda e)'Kd ed of one pose, with dv/dt from two
    neighbouring poses.
    """
    arm = CONSTANTS.arm
    later_s = np.array([[-STEP_S], [0.0], [STEP_S]])
    poses = q + later_s * qd
    errors = e + later_s * ed
    speeds = np.tile(qd, (3, 1))
    rates = np.tile(ed, (3, 1))
    following = build_following(arm, poses, speeds, CONSTANTS.Lambda)
    v, a = following.compute_reference(slice(None), errors, rates)
    v_rate = (v[2] - v[0]) / (2.0 * STEP_S)
    r = qd - v[1]
    tip = arm.place_end_effector(poses, speeds)
    deviation = tip.J[1] @ r - tip.speed[1] - CONSTANTS.Lambda * e
    momentum = arm.multiply_inertia(poses[1:2], r[np.newaxis])[0]
    return float(momentum @ (a[1] - v_rate) - deviation @ (CONSTANTS.Kd * ed))


ticks = st.integers(1, NOW - 2)


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), ticks, ticks)
def test_damping_work_uses_errors_before_a_jump(seed: int, before: int, after: int) -> None:
    """The power at both ends of a period follows from the equation of the theory, with the age
    of the sample in use kept until the end.
    """
    random = np.random.default_rng(seed)
    peer = draw_task_records(random, "m", {}, ROWS, 0)
    track = draw_task_records(random, "s", {"m": np.array([before, after])}, 2, NOW)
    view = track.view_delayed_peer(PeerTrajectory(peer))
    track.q_des[:] = view.delayed.q
    ones = np.ones((2, 1))
    none = np.zeros((2, 2))
    motion = SiteMotion(
        records=track,
        constants=CONSTANTS,
        dominance=DominanceHistory(ones, 0.0 * ones, ones[:1]),
        peers={"m": view},
        torque=TorqueSplit(
            CONSTANTS.arm.place_end_effector(track.q, track.qd), none, none, none, none
        ),
        common=CONSTANTS.axes,
    )
    work = motion.compute_work()["singular poses"]
    left = find_damping_power(track.q[0], track.qd[0], track.e[0], track.ed[0])
    right = find_damping_power(
        track.q[1],
        track.qd[1],
        track.x[1] - peer.x[before + 1],
        track.xd[1] - peer.xd[before + 1],
    )
    half_s = 0.5 / RATE_HZ
    assert float(work.left[0]) == pytest.approx(half_s * left, rel=1e-5, abs=1e-7)
    assert float(work.right[0]) == pytest.approx(half_s * right, rel=1e-5, abs=1e-7)
    assert left != 0.0
