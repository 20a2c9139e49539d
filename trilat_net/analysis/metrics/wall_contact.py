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
from .metric_catalogue import MetricValues, metric, unavailable

CONTACT_END_S = 5.0
"""Length of the end of a run that the second half of the quantities looks at, s."""

RUN_CONTACT_KEYS = (
    "force_mean_n",
    "force_deviation_n",
    "force_peak_n",
    "hits",
    "contact_share",
    "depth_max_m",
)
END_CONTACT_KEYS = ("end_force_mean_n", "end_force_deviation_n", "end_force_peak_n", "end_hits")
CONTACT_KEYS = (*RUN_CONTACT_KEYS, *END_CONTACT_KEYS)


class WallContact(NamedTuple):
    """A wall as a tip met it, over the recorded ticks.

    Attributes:
        t_s: shape (K,), s.
        force: along its normal, shape (K,), N.
        depth: of the tip in it, shape (K,), m.
        began: whether the force began at that tick, shape (K,).
    """

    t_s: Array
    force: Array
    depth: Array
    began: Bools


def list_walls(spec: SiteSpec) -> list[TorqueSource]:
    """Returns the walls of a site, in scenario order."""
    return [one.actor for one in spec.environment if one.actor.acts is TorqueKind.WALL]


def find_wall_contact(actor: TorqueSource, track: AlignedRecords, tip: EndEffectorRows) -> WallContact:
    """Returns how a tip met a wall."""
    t_s = track.nominal_s
    force = wall_force(actor, t_s, tip)
    touches = force > 0.0
    # the first record, of all and behind a gap, begins nothing: nobody knows since when it touches
    begins = touches & np.concatenate([[False], ~touches[:-1] & track.known[:-1]])
    known = track.known
    return WallContact(t_s[known], force[known], wall_depth(actor, tip)[known], begins[known])


def measure_wall_contact(
    actor: TorqueSource, track: AlignedRecords | None, tip: EndEffectorRows | None
) -> MetricValues:
    """Returns force, hits and depth of a wall, over the run and over its last 5 s.

    Args:
        actor: the wall.
        track: the site's records; None without any.
        tip: where its tip was.
    """
    if track is None or tip is None:
        return unavailable(CONTACT_KEYS, "no records of the site")
    how = find_wall_contact(actor, track, tip)
    last = how.t_s > how.t_s[-1] - CONTACT_END_S
    found = _contact_metrics(how, np.ones(len(last), dtype=np.bool_), RUN_CONTACT_KEYS[:4])
    return {
        **found,
        "contact_share": metric(float((how.force > 0.0).mean())),
        "depth_max_m": metric(max(0.0, float(how.depth.max()))),
        **_contact_metrics(how, last, END_CONTACT_KEYS),
    }


def _contact_metrics(how: WallContact, rows: Bools, keys: tuple[str, ...]) -> MetricValues:
    force = how.force[rows]
    values = (force.mean(), force.std(), force.max(), np.count_nonzero(how.began[rows]))
    return {key: metric(float(value)) for key, value in zip(keys, values, strict=True)}
