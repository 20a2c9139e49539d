"""Splits the torque on an arm into operator and environment, over all of its rows at once.

Invariant: a torque that the scenario does not explain is the operator's: the record's torque less the
environment's. An operator has a script only if its torque matches the scenario.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ..core.exogenous import TorqueKind, TorqueSource
from ..core.two_link_arm import JOINTS
from ..core.vectors import Array
from ..scenario import SiteSpec
from ..scenario.operators import ActorBase
from .aligned import AlignedRecords
from .arm_rows import EndEffectorRows, compute_end_effector
from .torque_sources import compute_source_torque, compute_spring_effort

SCRIPT_TORQUE_TOLERANCE = 1e-8
"""Relative difference up to which a torque is the scenario's."""


class TorqueSplit(NamedTuple):
    """The torque ON an arm over its rows, shape (K, 2) each, N m.

    Attributes:
        end_effector: its position, speed and Jacobian.
        operator_now, operator_held: of the operator: a function of the present, and computed once a tick.
        environment_now, environment_held: the same of the environment.
        script: the operator's intention, see `compute_operator_script`; None if not asked for, or if its
            torque does not match the scenario.
    """

    end_effector: EndEffectorRows
    operator_now: Array
    operator_held: Array
    environment_now: Array
    environment_held: Array
    script: Array | None = None

    @property
    def operator(self) -> Array:
        """Of the operator in all, shape (K, 2), N m."""
        return self.operator_now + self.operator_held

    @property
    def environment(self) -> Array:
        """Of the environment in all, shape (K, 2), N m."""
        return self.environment_now + self.environment_held


def split_torque(records: AlignedRecords, spec: SiteSpec) -> TorqueSplit:
    """Returns the torque on an arm by its sources, held and not; without the script."""
    end_effector = compute_end_effector((spec.arm.l1_m, spec.arm.l2_m), records.q, records.qd)
    t_s = records.nominal_s

    def add(sources: Iterable[ActorBase], *, sampled: bool) -> Array:
        total = np.zeros_like(records.q)
        for source in (one.actor for one in sources if one.actor.sampled is sampled):
            total = total + compute_source_torque(source, t_s, records.q, records.qd, end_effector)
        return total

    now, held = add(spec.environment, sampled=False), add(spec.environment, sampled=True)
    operator_held = add(spec.hands, sampled=True)
    operator_now = -records.tau_x - now - held - operator_held
    return TorqueSplit(end_effector, operator_now, operator_held, now, held)


def compute_operator_script(source: TorqueSource, t_s: Array, J: Array) -> Array:
    """Returns the intention of an operator, which does not depend on the arm's motion, shape (K, 2), N m.

    A pulse or a recorded torque itself; of a spring K times the displacement of its target and B times its
    speed, of one in the plane by the Jacobian J of one pose, shape (2, 2). It moves if and only if the
    operator does.
    """
    if source.acts is TorqueKind.PULSE:
        x = np.clip((t_s - source.start_s) / (source.end_s - source.start_s), 0.0, 1.0)
        intent = np.sin(np.pi * x)[:, None] ** 2 * np.array(source.a)
    elif source.acts is TorqueKind.RECORDED and source.table is not None:
        at_s, rows = source.table[:, 0], source.table[:, 1:]
        columns = [np.interp(t_s, at_s, column, left=0.0, right=0.0) for column in rows.T]
        intent = np.stack(columns, axis=1)
    else:
        origin = np.zeros((len(t_s), JOINTS))
        pull = compute_spring_effort(source, t_s, origin, origin)
        intent = pull @ J if source.acts is TorqueKind.TASK_HAND else pull
    acting = (t_s >= source.start_s) & (t_s < source.end_s)
    return np.where(acting[:, None], intent, 0.0)


def attribute_torque(records: AlignedRecords, spec: SiteSpec) -> TorqueSplit:
    """Returns the torque on an arm by its sources, with the operator's script.

    Without an operator in the scenario, the operator's torque is exactly zero where only rounding is left.
    """
    split, t_s = split_torque(records, spec), records.nominal_s
    expected, scripts = np.zeros_like(records.q), np.zeros_like(records.q)
    for source in (one.actor for one in spec.hands):
        script = compute_operator_script(source, t_s, split.end_effector.J[0])
        scripts = scripts + script
        if source.acts in (TorqueKind.PULSE, TorqueKind.RECORDED):
            expected = expected + script
        elif not source.sampled:
            torque = compute_source_torque(source, t_s, records.q, records.qd, split.end_effector)
            expected = expected + torque
    tolerance = SCRIPT_TORQUE_TOLERANCE * (1.0 + np.abs(records.tau_x))
    matches = np.abs(split.operator_now - expected) <= tolerance
    if matches[records.known].all():
        split = split._replace(script=scripts)
    if not spec.hands:
        split = split._replace(operator_now=np.where(matches, 0.0, split.operator_now))
    return split
