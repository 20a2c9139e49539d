"""What walls were met with: the force along the normal, by the scenario's wall at the logged states.

Law: a wall is as its scenario says; where its tick was not recorded, nothing is said of it.
"""

from typing import NamedTuple

import numpy as np

from ..analysis.actors import Tip, wall_depth, wall_force
from ..certificate.track import Bools, Track
from ..core.arm import Array
from ..core.exogenous import Actor, Acts
from ..scenario import SiteSpec
from .said import Facts, said, unsaid

LAST_S = 5.0
"""Length of the end of a run that the second half of the quantities looks at, s."""

WHOLE = (
    "force_mean_n",
    "force_deviation_n",
    "force_peak_n",
    "hits",
    "contact_share",
    "depth_max_m",
)
END = ("end_force_mean_n", "end_force_deviation_n", "end_force_peak_n", "end_hits")
WALL = (*WHOLE, *END)


class Met(NamedTuple):
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


def walls(spec: SiteSpec) -> list[Actor]:
    """Returns the walls of a site, in scenario order."""
    return [one.actor for one in spec.environment if one.actor.acts is Acts.WALL]


def met(actor: Actor, track: Track, tip: Tip) -> Met:
    """Returns how a tip met a wall."""
    t_s = track.nominal_s
    force = wall_force(actor, t_s, tip)
    touches = force > 0.0
    # the first record, of all and behind a gap, begins nothing: nobody knows since when it touches
    begins = touches & np.concatenate([[False], ~touches[:-1] & track.known[:-1]])
    known = track.known
    return Met(t_s[known], force[known], wall_depth(actor, tip)[known], begins[known])


def of_wall(actor: Actor, track: Track | None, tip: Tip | None) -> Facts:
    """Returns force, hits and depth of a wall, over the run and over its last 5 s.

    Args:
        actor: the wall.
        track: the site's records; None without any.
        tip: where its tip was.
    """
    if track is None or tip is None:
        return unsaid(WALL, "no records of the site")
    how = met(actor, track, tip)
    last = how.t_s > how.t_s[-1] - LAST_S
    found = _of(how, np.ones(len(last), dtype=np.bool_), WHOLE[:4])
    return {
        **found,
        "contact_share": said(float((how.force > 0.0).mean())),
        "depth_max_m": said(max(0.0, float(how.depth.max()))),
        **_of(how, last, END),
    }


def _of(how: Met, rows: Bools, keys: tuple[str, ...]) -> Facts:
    force = how.force[rows]
    values = (force.mean(), force.std(), force.max(), np.count_nonzero(how.began[rows]))
    return {key: said(float(value)) for key, value in zip(keys, values, strict=True)}
