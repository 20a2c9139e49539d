"""Sampled walls: the energy that they give to an arm, and the damping that would take it.

Invariant: a wall of stiffness K and damping B that is held over a tick h does the work F_k (x_{k+1} - x_k);
with its spring's energy K x^2 / 2 booked, it gives K (x_{k+1} - x_k)^2 / 2 in every tick of a contact, less
what its damping takes. A damper b of the arm itself takes all of it if b > K h / 2 + B: Colgate and Schenkel,
"Passivity of a class of sampled-data systems", J. Robotic Systems 14 (1997). That is sufficient, for a B on
the speed at the tick while that is straight within one (docs/certificate.md); whether the loop is stable in
contact is told by the map from tick to tick, `trilat linear`.
"""

from typing import NamedTuple

import numpy as np

from ...core.exogenous import TorqueKind, TorqueSource
from ...core.vectors import Array
from ...log.log_reader import Log
from ...scenario import SiteSpec
from ..aligned import AlignedRecords, align_records
from ..arm_rows import EndEffectorRows, build_arm_rows
from ..torque_sources import list_walls, wall_depth, wall_force
from .energy_balance import rise_above_minimum


class WallEnergy(NamedTuple):
    """A sampled wall that was touched.

    Attributes:
        site: whose wall.
        gave_j: the most that it gave in qd beyond what its spring had stored, J.
        needed_n_s_m: K h / 2 + B, N s/m.
        damping_n_s_m: the arm's own damping b along the normal, the least in contact, N s/m.
    """

    site: str
    gave_j: float
    needed_n_s_m: float
    damping_n_s_m: float


def find_wall_energies(log: Log) -> list[WallEnergy]:
    """Returns the sampled walls that were touched, in scenario order."""
    found = []
    for site, records in align_records(log).items():
        spec = log.scenario.sites[site]
        end_effector = build_arm_rows(log.scenario, site).place_end_effector(records.q, records.qd)
        for wall in list_sampled_walls(spec):
            force = wall_force(wall, records.nominal_s, end_effector)
            if (force > 0.0).any():
                needed = 0.5 * wall.K[0] * records.h_s + wall.B[0]
                gave = _find_given_energy(wall, records, end_effector, force)
                touched = force > 0.0
                own = _find_own_damping(spec, wall, end_effector.J[touched], records.nominal_s[touched])
                found.append(WallEnergy(site, gave, needed, own))
    return found


def list_sampled_walls(spec: SiteSpec) -> list[TorqueSource]:
    """Returns the walls of a site that are held over a tick, and that push back."""
    return [wall for wall in list_walls(spec) if wall.sampled and any(wall.K)]


def _find_given_energy(
    wall: TorqueSource, records: AlignedRecords, end_effector: EndEffectorRows, force: Array
) -> float:
    """Returns the largest rise of the wall's work on the arm with its spring's energy added, J."""
    torque = np.einsum("kij,ki->kj", end_effector.J, force[:, None] * np.array(wall.b))
    work = (torque[:-1] * np.diff(records.q, axis=0)).sum(axis=1)
    spring = 0.5 * wall.K[0] * np.where(force > 0.0, wall_depth(wall, end_effector), 0.0) ** 2
    change = np.where(records.known_periods, work + np.diff(spring), 0.0)
    return float(rise_above_minimum(np.concatenate([[0.0], np.cumsum(change)])).max())


def _find_own_damping(spec: SiteSpec, wall: TorqueSource, J: Array, t_s: Array) -> float:
    """Returns the least of 1 / (n'J D^-1 J'n), D the damping of joints that acts continuously, N s/m.

    J and t_s are of the rows in contact; what does not act at all of them is no damping.
    """
    actors = [one.actor for one in spec.environment]
    lasting = [one for one in actors if one.start_s <= t_s[0] and one.end_s > t_s[-1]]
    viscous = [one.B for one in lasting if one.acts is TorqueKind.VISCOUS and not one.sampled]
    D = np.sum(viscous, axis=0) if viscous else np.zeros(J.shape[2])
    arms = np.einsum("kij,i->kj", J, np.array(wall.b)) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        compliance = np.where(arms > 0.0, arms / D, 0.0).sum(axis=1)
        return float((1.0 / compliance).min())
