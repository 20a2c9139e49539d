"""What a stop can take: how long an arm moves, how fast its joints may get, and which speed its
motors bear.

The bounds follow from the model of the arm, the limits of its torques and the way in which it
comes to rest (`core.resting`); docs/links.md derives them. The numbers of its equations stand
beside the lines.

Invariant:

- The same scenario has the same bounds: poses are drawn by a fixed seed.
"""

import math
from itertools import islice, product
from typing import NamedTuple

import numpy as np

from ..core.chain import build_chain, inverse_dynamics, place_joints, propagate_motion
from ..core.resting import REST_RATE_1_S
from ..core.site_setup import Law, SiteSetup
from ..core.two_link_arm import ArmLinks, theta_from_links
from ..core.vectors import Array
from .arms import Arm, ArmModel
from .scenario_types import Scenario

AT_REST_RAD_S = 0.05
"""An arm whose joints are slower than this is at rest."""
SETTLE_TIMES = 10.0
"""So many times `RestGains.time_s` pass until what the torque at rest took on has died away."""
_POSES = 100
_LEAST_NM = 1e-300
"""So that no division is by zero."""
_PATTERNS = 64
"""Most combinations of the joints' directions that are looked at."""


class RestBounds(NamedTuple):
    """Bounds of a stop from a speed of the joints.

    Attributes:
        rest_s: the time within which the arm is at rest; inf: its motors cannot hold it.
        bearable_share: the share of the speed up to which motors hold what joints do to each other.
        kinetic_j: the largest kinetic energy at that speed, J.
        blend_j: the most energy that last torques add.
        peak_rad_s: the largest speed that energy allows each joint, shape (n,).
    """

    rest_s: float
    bearable_share: float
    kinetic_j: float
    blend_j: float
    peak_rad_s: Array


class _ArmSamples(NamedTuple):
    """The dynamics of an arm in many poses.

    Attributes:
        M: inertia, shape (poses, n, n).
        G: absolute torque of gravity, N m, shape (poses, n).
        coriolis: largest absolute Coriolis torque of all directions of the joints, N m, shape
            (poses, n).
    """

    M: Array
    G: Array
    coriolis: Array


def find_rest_bounds(scenario: Scenario, site: str, qd: Array | None = None) -> RestBounds:
    """Returns the bounds of a stop from a speed of the joints.

    Args:
        scenario: the scenario; the site has the rule `glide`.
        site: the site.
        qd: speed of each joint, rad/s, shape (n,); None: the limits of its speed.
    """
    spec = scenario.sites[site]
    setup = scenario.setup(site)
    joints = len(spec.q0_rad)
    speed = np.abs(np.broadcast_to(setup.qd_limit_rad_s if qd is None else qd, joints)).astype(
        float
    )
    limit = np.broadcast_to(setup.tau_limit_nm, joints).astype(float)
    arm = _sample_planar_arm(spec.arm, speed)
    if spec.arm.urdf:
        arm = _sample_chain(scenario.arms[site], np.array(spec.q0_rad), speed)
    beyond_gravity = np.maximum(limit - arm.G, 0.0)
    shares = beyond_gravity / np.maximum(arm.coriolis, _LEAST_NM)
    kinetic_j = max(
        float(0.5 * v @ M @ v) for M in arm.M for v in speed * _list_patterns(joints)
    )
    damping = np.broadcast_to(setup.rest.damping, joints)
    blend_j = float((0.5 * limit**2 / damping).sum()) / setup.rate_hz  # (5)
    mobility = np.linalg.inv(arm.M).diagonal(axis1=1, axis2=2).max(axis=0)
    return RestBounds(
        rest_s=_bound_rest_time(
            setup=setup, speed=speed, limit=limit, arm=arm, energy_j=kinetic_j + blend_j
        ),
        bearable_share=math.sqrt(float(shares.min())),  # (7)
        kinetic_j=kinetic_j,
        blend_j=blend_j,
        peak_rad_s=np.sqrt(2.0 * mobility * (kinetic_j + blend_j)),  # (6)
    )


def _bound_rest_time(
    setup: SiteSetup, speed: Array, limit: Array, arm: _ArmSamples, energy_j: float
) -> float:
    """Returns the time of Eq. (8), s."""
    gravity_nm = arm.G.max(axis=0)
    available = limit - gravity_nm
    if np.any(available <= 0.0):
        return math.inf
    slowness = float(np.linalg.eigvalsh(arm.M / np.outer(available, available))[:, -1].max())
    braking_s = float(setup.rest.stop_s(speed)) + math.sqrt(2.0 * energy_j * slowness)
    adapts = setup.gains.law is Law.ADAPTIVE and not setup.layout.task
    rate_1_s = float(np.min(setup.gains.Lambda)) if adapts else REST_RATE_1_S
    time_s = setup.rest.time_s
    apart_rad = 2.0 * time_s * float((limit / setup.rest.damping).max())
    returning_s = math.log(max(1.0, rate_1_s * apart_rad / AT_REST_RAD_S)) / rate_1_s
    ramp_s = float((gravity_nm / np.asarray(setup.limits.tau_rate)).max())
    return braking_s + SETTLE_TIMES * time_s + returning_s + ramp_s


def _list_patterns(joints: int) -> Array:
    """Returns directions of the joints, each 1 or -1, shape (patterns, joints); the first
    joint's is 1.
    """
    rows = islice(product((1.0, -1.0), repeat=joints - 1), _PATTERNS)
    return np.array([(1.0, *row) for row in rows])


def _draw_poses(model: ArmModel, q0: Array) -> Array:
    """Returns poses within the stops of the joints, the start pose first, shape (poses, n)."""
    assert model.chain is not None
    low = [
        joint.lower if math.isfinite(joint.lower) else -math.pi for joint in model.chain.joints
    ]
    high = [
        joint.upper if math.isfinite(joint.upper) else math.pi for joint in model.chain.joints
    ]
    drawn = np.random.default_rng(0).uniform(low, high, (_POSES, len(q0)))
    return np.vstack([q0, drawn])


def _sample_planar_arm(arm: Arm, speed: Array) -> _ArmSamples:
    """Returns the planar two-link arm by the paper's Eq. (2) to (5) and (24), for all angles of
    its elbow.
    """
    a, b, c, first, second = theta_from_links(
        ArmLinks(*(getattr(arm, name) for name in ArmLinks._fields))
    )
    elbow = np.linspace(-math.pi, math.pi, _POSES + 1)
    across = c + b * np.cos(elbow)
    M = np.array([[a + 2.0 * b * np.cos(elbow), across], [across, np.full_like(elbow, c)]])
    upper = abs(first) * arm.g_m_s2
    lower = abs(second) * arm.g_m_s2
    slope = np.abs(b * np.sin(elbow))
    pushes = np.array([2.0 * speed[0] * speed[1] + speed[1] ** 2, speed[0] ** 2])
    return _ArmSamples(
        M=np.moveaxis(M, 2, 0),
        G=np.broadcast_to([upper + lower, lower], (len(elbow), 2)),
        coriolis=slope[:, np.newaxis] * pushes,
    )


def _sample_chain(model: ArmModel, q0: Array, speed: Array) -> _ArmSamples:
    """Returns a chain in its start pose and in drawn ones; friction, which only takes power, is
    left out.
    """
    assert model.chain is not None
    gravity = np.array(model.chain.gravity_m_s2)
    rows = build_chain(
        [joint._replace(viscous=0.0, coulomb=0.0) for joint in model.chain.joints]
    )
    joints = len(q0)
    still = np.zeros(joints)
    torque = np.zeros(joints)
    patterns = speed * _list_patterns(joints)
    inertias = []
    gravities = []
    pushes = []
    for q in _draw_poses(model, q0):
        inertias.append(model.inertia(q))
        place_joints(rows, q)
        propagate_motion(chain=rows, gravity=gravity, qd=still, v=still, a=still)
        inverse_dynamics(chain=rows, theta=model.theta, v=still, a=still, torque=torque)
        G = torque.copy()
        coriolis = np.zeros(joints)
        for v in patterns:
            propagate_motion(chain=rows, gravity=gravity, qd=v, v=v, a=still)
            inverse_dynamics(chain=rows, theta=model.theta, v=v, a=still, torque=torque)
            coriolis = np.maximum(coriolis, np.abs(torque - G))
        gravities.append(np.abs(G))
        pushes.append(coriolis)
    return _ArmSamples(np.array(inertias), np.array(gravities), np.array(pushes))
