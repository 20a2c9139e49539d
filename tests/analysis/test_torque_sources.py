"""Torques of hands and environments over all rows equal the integrator's own functions at each row."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.analysis.builders import make_run
from trilat_net.analysis.aligned import AlignedRecords
from trilat_net.analysis.arm_rows import PlanarArmRows
from trilat_net.analysis.torque_sources import SourceRows, TorqueSplit
from trilat_net.core.arms import exogenous
from trilat_net.core.arms.exogenous import TorqueKind, TorqueSource, torque_source_rows

real = st.floats(-2.0, 2.0)
pairs = st.tuples(real, real)
gains = st.tuples(st.floats(0.0, 500.0), st.floats(0.0, 500.0))


@st.composite
def draw_source(draw: st.DrawFn) -> TorqueSource:
    acts = draw(
        st.sampled_from(
            [TorqueKind.HAND, TorqueKind.TASK_HAND, TorqueKind.VISCOUS, TorqueKind.WALL]
        )
    )
    start = draw(st.floats(0.0, 2.0))
    move = draw(st.floats(0.0, 2.0))
    angle = draw(st.floats(0.0, 6.3))
    after = (
        (float(np.cos(angle)), float(np.sin(angle))) if acts is TorqueKind.WALL else draw(pairs)
    )
    ends = (
        start,
        start + draw(st.floats(0.1, 2.0)),
        move,
        move + draw(st.sampled_from([0.0, 0.5, 1.5])),
    )
    return TorqueSource(acts, *ends, draw(pairs), after, draw(gains), draw(gains))


@settings(max_examples=60, deadline=None)
@given(
    draw_source(),
    st.lists(st.tuples(st.floats(0.0, 4.0), pairs, pairs), min_size=1, max_size=5),
)
def test_every_torque_equals_the_cores(
    actor: TorqueSource, states: list[tuple[float, tuple, tuple]]
) -> None:
    lengths = (0.8, 0.6)
    t_s = np.array([state[0] for state in states])
    q, qd = (np.array([state[n] for state in states]) for n in (1, 2))
    rows, table = torque_source_rows((actor,))
    expected = np.zeros_like(q)
    for n in range(len(states)):
        expected[n] = exogenous.source_torque(
            float(t_s[n]), q[n], qd[n], lengths, rows[0], table
        )[:2]
    torque = SourceRows(actor).compute_torque(
        t_s, q, qd, PlanarArmRows(np.zeros(5), 0.0, lengths).place_end_effector(q, qd)
    )
    np.testing.assert_allclose(torque, expected, rtol=1e-9, atol=1e-9)


def test_hand_and_environment_torques_sum_to_the_record() -> None:
    log = make_run("rich").log
    for site, track in AlignedRecords.by_site(log).items():
        by = TorqueSplit.with_script(track, log.scenario)
        np.testing.assert_allclose(by.operator + by.environment, -track.tau_x, atol=1e-9)
        assert (site == "s") == by.environment_now.any() == by.environment.any()
        assert (site == "m1") == (np.abs(by.operator_held).max() > 1e-9)
        assert (site == "m2") == (np.abs(by.operator_now).max() > 1e-9)
        assert by.script is not None  # every hand did what the scenario says


def test_an_unscripted_hand_has_no_script() -> None:
    log = make_run("rich").log
    track = AlignedRecords.by_site(log)["m2"]
    other = track._replace(tau_x=track.tau_x + 0.1)
    assert TorqueSplit.with_script(other, log.scenario).script is None


@pytest.mark.parametrize("acts", [TorqueKind.HAND, TorqueKind.TASK_HAND])
def test_scripts_are_torques_at_a_fixed_pose(acts: TorqueKind) -> None:
    actor = TorqueSource(
        acts, 0.0, 9.0, 1.0, 3.0, (0.1, 0.2), (0.5, -0.4), (50.0, 20.0), (5.0, 2.0)
    )
    t_s = np.linspace(0.0, 4.0, 41)
    still = np.tile([0.3, 1.1], (len(t_s), 1))
    tip = PlanarArmRows(np.zeros(5), 0.0, (1.0, 1.0)).place_end_effector(still, 0.0 * still)
    rows = SourceRows(actor)
    torque = rows.compute_torque(t_s, still, 0.0 * still, tip)
    script = rows.compute_script(t_s, tip.J[0])
    np.testing.assert_allclose(script - script[0], torque - torque[0], atol=1e-12)
