"""The arrays of a site whose arm of seven joints follows in task space."""

import numpy as np

from tests.core.chain_references import chain_references
from trilat_net.core.arms.chain import ChainJoint
from trilat_net.core.step.site_arrays import SiteArrays
from trilat_net.core.step.site_setup import (
    ChainSetup,
    Gains,
    Law,
    LinkSetup,
    Scheme,
    SiteSetup,
    TaskSetup,
)

CHAIN = chain_references()["arm7"].chain
THETA = np.concatenate([one.inertia for one in CHAIN.joints])
PLACE, POSE = TaskSetup((1.0,) * 3, 0.5), TaskSetup((1.0,) * 6, 1.0, posture_rate=0.7)


def build(task: TaskSetup) -> SiteArrays:
    """Returns the arrays of the site with a task."""
    joints = tuple(
        ChainJoint(one.kind == "prismatic", one.axis, one.rotation, one.origin_m)
        for one in CHAIN.joints
    )
    chain = ChainSetup(
        joints, tip_m=CHAIN.tip_origin_m, tip_rotation=CHAIN.tip_rotation, task=task
    )
    numbers = {"theta": THETA, "g_m_s2": 9.81, "lengths_m": (0.0, 0.0), "tau_limit_nm": 1e3}
    return SiteArrays.build(
        SiteSetup(
            name="a",
            rate_hz=1000,
            scheme=Scheme.SECOND_ORDER,
            gains=Gains(Law.ADAPTIVE, Lambda=(2.0,), Kp=(1.0,), Kd=(1.0,)),
            qd_limit_rad_s=100.0,
            q0=(0.0, -0.4, 0.2, -1.7, 0.1, 1.5, 0.3),
            qd0=(0.0,) * 7,
            actors=(),
            links=(LinkSetup("b", 1.0, 1000, (0.0,) * len(task.axes)),),
            chain=chain,
            **numbers,
        ),
        pages=8,
    )
