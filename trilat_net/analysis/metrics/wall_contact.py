"""Contact with walls: normal force, hits and depth, from the scenario's wall at the logged states.

Invariant: the wall is the scenario's; ticks without a record contribute nothing.
"""

from typing import NamedTuple

import numpy as np

from ...core.exogenous import TorqueKind, TorqueSource
from ...core.vectors import Array
from ...scenario import SiteSpec
from ..aligned import AlignedRecords, Bools
from ..arm_rows import EndEffectorRows
from ..torque_sources import wall_depth, wall_force
from .metric_catalogue import CONTACT, MetricValues, metric, unavailable

CONTACT_END_S = 5.0
"""Length of the end of a run for the quantities of the end, s."""


class WallContact(NamedTuple):
    """Contact of an end effector with a wall, over the K recorded ticks.

    Attributes:
        force, depth: along its normal, N, and m.
        began: True if the force began at that tick.
    """

    t_s: Array
    force: Array
    depth: Array
    began: Bools


def list_walls(spec: SiteSpec) -> list[TorqueSource]:
    """Returns the walls of a site, in scenario order."""
    return [one.actor for one in spec.environment if one.actor.acts is TorqueKind.WALL]


def find_wall_contact(
    wall: TorqueSource, records: AlignedRecords, end_effector: EndEffectorRows
) -> WallContact:
    """Returns the contact of an end effector with a wall.

    The first record, of all and after a gap, begins no contact: its beginning is unknown.
    """
    t_s, known = records.nominal_s, records.known
    force = wall_force(wall, t_s, end_effector)
    touches = force > 0.0
    begins = touches & np.concatenate([[False], ~touches[:-1] & known[:-1]])
    return WallContact(t_s[known], force[known], wall_depth(wall, end_effector)[known], begins[known])


def measure_wall_contact(
    wall: TorqueSource, records: AlignedRecords | None, end_effector: EndEffectorRows | None
) -> MetricValues:
    """Returns force, hits and depth of a wall, over the run and over its last 5 s; None without records."""
    if records is None or end_effector is None:
        return unavailable(CONTACT, "no records of the site")
    contact = find_wall_contact(wall, records, end_effector)
    metrics = {
        "contact_share": metric(float((contact.force > 0.0).mean())),
        "depth_max_m": metric(max(0.0, float(contact.depth.max()))),
    }
    for prefix, rows in (("", slice(None)), ("end_", contact.t_s > contact.t_s[-1] - CONTACT_END_S)):
        force = contact.force[rows]
        metrics[f"{prefix}force_mean_n"] = metric(float(force.mean()))
        metrics[f"{prefix}force_deviation_n"] = metric(float(force.std()))
        metrics[f"{prefix}force_peak_n"] = metric(float(force.max()))
        metrics[f"{prefix}hits"] = metric(float(np.count_nonzero(contact.began[rows])))
    return {key: metrics[key] for key in unavailable(CONTACT, "")}
