"""Bounds of a stop: how long it takes, how fast joints may get, and what motors bear.

The bounds follow from the model of the arm, the limits of its torques, and the rule by which
the arm comes to rest (`core.resting`). docs/links.md derives them; comments give the numbers of
its equations.

Invariant:
    - The same scenario has the same bounds: poses are drawn with a fixed seed.
"""

import math
from itertools import islice, product
from typing import NamedTuple

import numpy as np

from ..core.chain import build_chain, inverse_dynamics, place_joints, propagate_motion
from ..core.resting import REST_RATE_1_S
from ..core.site_setup import Law, SiteSetup
from ..core.two_link_arm import theta_from_links
from ..core.vectors import Array
from .arms import Arm, ArmModel
from .scenario_types import Scenario

AT_REST_RAD_S = 0.05
"""Speed of the joints below which an arm is at rest."""
SETTLE_TIMES = 10.0
"""Time constants `RestGains.time_s` within which the torque at rest forgets its start."""
_POSES = 100
_LEAST_NM = 1e-300
"""Keeps a divisor above zero."""
_MAX_PATTERNS = 64
"""Largest number of combinations of the joints' directions that are examined."""


class RestBounds(NamedTuple):
    """Bounds of a stop from a speed of the joints.

    Attributes:
        rest_s: the time within which the arm is at rest; inf: its motors cannot hold it.
        bearable_share: the share of the speed up to which the motors can hold the Coriolis
            torques between joints.
        kinetic_j: the largest kinetic energy at that speed, J.
        blend_j: the largest energy that the last torques before the stop add, J.
        peak_rad_s: the largest speed of each joint that the energy allows, shape (n,).
    """

    rest_s: float
    bearable_share: float
    kinetic_j: float
    blend_j: float
    peak_rad_s: Array


class _ArmSamples(NamedTuple):
    """The dynamics of an arm in many poses.

    Attributes:
        M: inertia matrix, shape (poses, n, n).
        G: absolute torque of gravity, N m, shape (poses, n).
        coriolis: largest absolute Coriolis torque over all directions of the joints, N m, shape
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
        qd: speed of each joint, rad/s, shape (n,); None: the limits of the speeds.
    """
    spec = scenario.sites[site]
    setup = scenario.setup(site)
    joints = len(spec.q0_rad)
    qd = np.asarray(setup.qd_limit_rad_s if qd is None else qd)
    speed = np.abs(np.broadcast_to(qd, joints)).astype(float)
    limit_nm = np.broadcast_to(setup.tau_limit_nm, joints).astype(float)
    if spec.arm.urdf:
        samples = _sample_chain(scenario.arms[site], np.array(spec.q0_rad), speed)
    else:
        samples = _sample_planar_arm(spec.arm, speed)
    beyond_gravity_nm = np.maximum(limit_nm - samples.G, 0.0)
    shares = beyond_gravity_nm / np.maximum(samples.coriolis, _LEAST_NM)
    velocities = speed * _list_patterns(joints)
    kinetic_j = max(float(0.5 * v @ M @ v) for M in samples.M for v in velocities)
    damping = np.broadcast_to(setup.rest.damping, joints)
    blend_j = float((0.5 * limit_nm**2 / damping).sum()) / setup.rate_hz  # (5)
    inverse_inertias = np.linalg.inv(samples.M)
    mobility = inverse_inertias.diagonal(axis1=1, axis2=2).max(axis=0)
    energy_j = kinetic_j + blend_j
    rest_s = _bound_rest_time(
        setup=setup,
        speed=speed,
        limit_nm=limit_nm,
        samples=samples,
        energy_j=energy_j,
    )
    return RestBounds(
        rest_s=rest_s,
        bearable_share=math.sqrt(float(shares.min())),  # (7)
        kinetic_j=kinetic_j,
        blend_j=blend_j,
        peak_rad_s=np.sqrt(2.0 * mobility * energy_j),  # (6)
    )


def _bound_rest_time(
    setup: SiteSetup, speed: Array, limit_nm: Array, samples: _ArmSamples, energy_j: float
) -> float:
    """Returns the time of Eq. (8), s; inf if the motors cannot hold the arm.

    Args:
        setup: the setup of the site.
        speed: speed of each joint at the beginning, rad/s, shape (n,).
        limit_nm: largest torque of each joint, N m, shape (n,).
        samples: the dynamics of the arm.
        energy_j: the largest energy at the beginning, J.
    """
    gravity_nm = samples.G.max(axis=0)
    available_nm = limit_nm - gravity_nm
    if np.any(available_nm <= 0.0):
        return math.inf

    # The motors brake the joints against the available torque.
    scaled_inertia = samples.M / np.outer(available_nm, available_nm)
    largest_eigenvalues = np.linalg.eigvalsh(scaled_inertia)[:, -1]
    slowness = float(largest_eigenvalues.max())
    braking_s = float(setup.rest.stop_s(speed)) + math.sqrt(2.0 * energy_j * slowness)

    # The joints return to the pose that they hold, with an exponential rate.
    adapts = setup.gains.law is Law.ADAPTIVE and not setup.layout.task
    rate_1_s = float(np.min(setup.gains.Lambda)) if adapts else REST_RATE_1_S
    time_s = setup.rest.time_s
    fastest_rad_s = float((limit_nm / setup.rest.damping).max())
    deviation_rad = 2.0 * time_s * fastest_rad_s
    initial_ratio = rate_1_s * deviation_rad / AT_REST_RAD_S
    returning_s = math.log(max(1.0, initial_ratio)) / rate_1_s

    # The limit on the torque's rate delays the torque that holds gravity.
    ramp_s = float((gravity_nm / np.asarray(setup.limits.tau_rate)).max())
    return braking_s + SETTLE_TIMES * time_s + returning_s + ramp_s


def _list_patterns(joints: int) -> Array:
    """Returns directions of the joints, 1 or -1 each, shape (patterns, joints).

    The first joint's direction is always 1, because the opposite pattern has the same energy
    and the same Coriolis torques.
    """
    all_patterns = product((1.0, -1.0), repeat=joints - 1)
    patterns = islice(all_patterns, _MAX_PATTERNS)
    return np.array([(1.0, *pattern) for pattern in patterns])


def _draw_poses(model: ArmModel, q0: Array) -> Array:
    """Returns the start pose and poses between the stops of the joints, shape (poses, n)."""
    assert model.chain is not None
    low = []
    high = []
    for joint in model.chain.joints:
        low.append(joint.lower if math.isfinite(joint.lower) else -math.pi)
        high.append(joint.upper if math.isfinite(joint.upper) else math.pi)
    generator = np.random.default_rng(0)
    poses = generator.uniform(low, high, (_POSES, len(q0)))
    return np.vstack([q0, poses])


def _sample_planar_arm(arm: Arm, speed: Array) -> _ArmSamples:
    """Returns the dynamics of the planar arm for all angles of its elbow.

    The equations are the paper's Eq. (2) to (5) and (24). The inertia and the Coriolis torques
    do not depend on the shoulder, and gravity is bounded over all poses.
    """
    a, b, c, first, second = theta_from_links(arm.planar_links())
    elbow = np.linspace(-math.pi, math.pi, _POSES + 1)
    coupling = c + b * np.cos(elbow)
    shoulder = a + 2.0 * b * np.cos(elbow)
    M = np.array([[shoulder, coupling], [coupling, np.full_like(elbow, c)]])
    upper_nm = abs(first) * arm.g_m_s2
    lower_nm = abs(second) * arm.g_m_s2
    slope = np.abs(b * np.sin(elbow))
    shoulder_product = 2.0 * speed[0] * speed[1] + speed[1] ** 2
    elbow_product = speed[0] ** 2
    speed_products = np.array([shoulder_product, elbow_product])
    return _ArmSamples(
        M=np.moveaxis(M, 2, 0),
        G=np.broadcast_to([upper_nm + lower_nm, lower_nm], (len(elbow), 2)),
        coriolis=slope[:, np.newaxis] * speed_products,
    )


def _sample_chain(model: ArmModel, q0: Array, speed: Array) -> _ArmSamples:
    """Returns the dynamics of a chain in its start pose and in drawn poses.

    Friction is left out: it only dissipates energy.
    """
    assert model.chain is not None
    gravity = np.array(model.chain.gravity_m_s2)
    frictionless = [joint._replace(viscous=0.0, coulomb=0.0) for joint in model.chain.joints]
    rows = build_chain(frictionless)
    joints = len(q0)
    still = np.zeros(joints)
    velocities = speed * _list_patterns(joints)

    def compute_torque(v: Array) -> Array:
        """Returns the torque of the motion at `v` without acceleration, in the current pose."""
        torque = np.zeros(joints)
        propagate_motion(chain=rows, gravity=gravity, qd=v, v=v, a=still)
        inverse_dynamics(chain=rows, theta=model.theta, v=v, a=still, torque=torque)
        return torque

    inertias = []
    gravity_torques = []
    coriolis_torques = []
    for q in _draw_poses(model, q0):
        inertias.append(model.inertia(q))
        place_joints(rows, q)
        G = compute_torque(still)
        coriolis = np.zeros(joints)
        for v in velocities:
            coriolis = np.maximum(coriolis, np.abs(compute_torque(v) - G))
        gravity_torques.append(np.abs(G))
        coriolis_torques.append(coriolis)
    return _ArmSamples(
        M=np.array(inertias),
        G=np.array(gravity_torques),
        coriolis=np.array(coriolis_torques),
    )
