"""Ports of sites that follow in task space: force and velocity of the end effector, along the followed axes.

Invariant: the loop is the same, in other coordinates. With J the Jacobian of a site's followed axes at rest
and N a basis of the joint motions that leave them alone, x = J q and z = N' q stand in place of q, so that a
force F on the end effector is the torque J' F and its velocity is x'. A port is numbered as its coordinate,
1 to 3 a place, 4 to 6 turns, and its position's state is called "q" with that number, as a joint's is.
"""

import numpy as np
from scipy.linalg import block_diag, null_space

from ..core.site_setup import SiteSetup
from ..core.vectors import Array
from ..scenario.arms import TASK_AXES
from .linear_loop import LinearLoop, gather_site_arguments
from .operating_point import Equilibrium, OperatingConditions
from .site_dynamics import follow_peers, lay_out_arguments, place_arm


def list_followed_axes(site: SiteSetup) -> list[int]:
    """Returns the coordinates that a site follows, from 1 on: of joint space all joints."""
    if site.chain is None or site.chain.task is None:
        return list(range(1, site.layout.joints + 1))
    return [n for n, on in enumerate(site.chain.task.axes, 1) if on]


def name_ports(conditions: OperatingConditions) -> dict[int, str]:
    """Returns what the ports of each number are called: the axes of a task, or {} for the joints."""
    if not conditions.sites[0].layout.task:
        return {}
    followed = sorted({n for site in conditions.sites for n in list_followed_axes(site)})
    return {n: TASK_AXES[n - 1] for n in followed}


def use_end_effector_ports(
    conditions: OperatingConditions, rest: Equilibrium, loop: LinearLoop
) -> LinearLoop:
    """Returns a loop with ports at the end effectors, if its sites follow with them; else the loop."""
    if not conditions.sites[0].layout.task:
        return loop
    blocks, inverses, names, ports = [], [], [], []
    for site, x in zip(conditions.sites, gather_site_arguments(conditions, rest), strict=True):
        at, followed = lay_out_arguments(site), list_followed_axes(site)
        whole = follow_peers(site, place_arm(site, x[at.q]), x).J
        assert whole is not None
        J: Array = whole[[n - 1 for n in followed]]
        free = null_space(J)
        T, inverse = np.vstack([J, free.T]), np.hstack([np.linalg.pinv(J), free])
        estimates = [name for name in loop.names if name.startswith(f"{site.name}.")][2 * at.joints :]
        rest_of_site = np.eye(len(estimates))
        blocks.append(block_diag(T, T, rest_of_site))
        inverses.append(block_diag(inverse, inverse, rest_of_site))
        free_names = [f"free{n + 1}" for n in range(free.shape[1])]
        for kind, slow in (("q", ""), ("qd", "d")):
            names += [f"{site.name}.{kind}{n}" for n in followed]
            names += [f"{site.name}.{name}{slow}" for name in free_names]
        names += estimates
        ports.append(J)
    change, back, J = block_diag(*blocks), block_diag(*inverses), block_diag(*ports)
    numbers = [(site.name, n) for site in conditions.sites for n in list_followed_axes(site)]
    inputs, outputs = (tuple(f"{site}.{kind}{n}" for site, n in numbers) for kind in ("tau", "qd"))
    delayed = tuple(term._replace(A=change @ term.A @ back, B=change @ term.B @ J.T) for term in loop.delayed)
    return loop._replace(
        names=tuple(names),
        inputs=inputs,
        outputs=outputs,
        A=change @ loop.A @ back,
        B=change @ loop.B @ J.T,
        C=J @ loop.C @ back,
        delayed=delayed,
    )
