"""The motion that a law promises, against closed solutions of its target model."""

import numpy as np
import pytest

from trilat_net.core.step.vectors import Array
from trilat_net.laws.impedance import move_impedance
from trilat_net.laws.interface import LawSettings, TuningRun
from trilat_net.scenario.laws import BUILT_IN

H_S = 1e-3
T_S = H_S * np.arange(20_001)
IMPEDANCE = BUILT_IN["impedance"].Settings
MASTER = IMPEDANCE(M=(2.0,), B=(10.0,), K=(50.0,))
SLAVE = IMPEDANCE(M=(2.0,), B=(10.0,), K=(50.0,), follows=True)
SHARES = np.array([[0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.75, 0.25, 0.0]])


def make_run(outside_nm: Array, laws: list[LawSettings], start_rad: float = 0.0) -> TuningRun:
    """Three sites of one joint that stay at their start pose, under torques from outside."""
    q = np.full((3, len(T_S), 1), start_rad)
    alpha = np.tile(SHARES, (len(T_S), 1, 1))
    return TuningRun(laws, T_S, q, outside_nm, alpha)


def push(user_nm: float = 0.0, slave_nm: float = 0.0) -> Array:
    """Returns constant torques from outside on the first user and on the slave."""
    outside_nm = np.zeros((3, len(T_S), 1))
    outside_nm[0] = user_nm
    outside_nm[2] = slave_nm
    return outside_nm


def test_mass_on_a_spring_has_closed_form_motion() -> None:
    """M qdd + B qd + K q = F: F / K (1 - exp(-s t) (cos(w t) + s / w sin(w t)))."""
    motion = move_impedance(MASTER, np.full((len(T_S), 1), 3.0), H_S)[:, 0]
    decay = 10.0 / 4.0
    omega = np.sqrt(50.0 / 2.0 - decay**2)
    swing = np.cos(omega * T_S) + decay / omega * np.sin(omega * T_S)
    assert motion == pytest.approx(3.0 / 50.0 * (1.0 - np.exp(-decay * T_S) * swing), abs=1e-10)


def test_impedance_target_rests_as_documented() -> None:
    """docs/data/laws-unit-arm.csv: K = 50, shares .75 / .25, 3 N m on user 1: user 1 .06, slave .045."""
    target = MASTER.target_motion(make_run(push(user_nm=3.0), [MASTER, MASTER, SLAVE], 0.2))
    assert target is not None
    assert target[:, 0, 0] == pytest.approx([0.2, 0.2, 0.2])
    assert target[:, -1, 0] - 0.2 == pytest.approx([0.06, 0.0, 0.045], abs=1e-6)


def test_target_model_shares_the_walls_torque() -> None:
    """f_j = alpha_j tau_h: -2 N m at the slave are -1.5 and -0.5 N m at the users."""
    target = MASTER.target_motion(make_run(push(slave_nm=-2.0), [MASTER, MASTER, SLAVE]))
    assert target is not None
    users = [-1.5 / 50.0, -0.5 / 50.0]
    slave = 0.75 * users[0] + 0.25 * users[1] - 2.0 / 50.0
    assert target[:, -1, 0] == pytest.approx([*users, slave], abs=1e-6)


def test_sync_promises_agreement_and_no_pose() -> None:
    law = BUILT_IN["sync"].Settings()
    run = make_run(push(), [law] * 3)
    q = np.random.default_rng(1).normal(size=run.q.shape)
    target = law.target_motion(run._replace(q=q))
    assert target is not None
    assert target[1] == pytest.approx((q[0] + q[1] + q[2]) / 3.0)


def test_other_laws_promise_agreement_at_hands_pose() -> None:
    for name, kind in BUILT_IN.items():
        if name in ("impedance", "sync"):
            continue
        law = kind.Settings()
        assert law.target_motion(make_run(push(), [law] * 3)) is None
    mixed = make_run(push(), [MASTER, BUILT_IN["p_d"].Settings(), SLAVE])
    assert MASTER.target_motion(mixed) is None
    assert MASTER.target_motion(make_run(push(), [MASTER] * 3)) is None
