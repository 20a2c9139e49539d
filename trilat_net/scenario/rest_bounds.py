"""Computes bounds on how long an arm takes to stop and how fast its joints can move.

When an arm must stop, for example because the network failed, its controller damps each joint
in proportion to its speed, within the torque limits (`core.resting`). This module derives
bounds on the stopping time and on the speeds from the model of the arm and these limits. It
also determines whether the motors are strong enough for the arm's gravity and Coriolis torques.

The formulas are derived in docs/theory/coming-to-rest.md; equation numbers in comments refer to
that page.

Invariant:
    - The bounds are deterministic for a given scenario. The model is evaluated at random poses,
      but the seed of the generator is fixed.
"""

import math
from itertools import islice, product
from typing import NamedTuple

import numpy as np

from ..core import REST_RATE_1_S, Array, ChainDynamics, SiteSetup
from .arms import Arm, ArmModel
from .scenario_types import Scenario

AT_REST_RAD_S = 0.05
"""Joint speed below which an arm is considered at rest, in rad/s."""
SETTLE_TIMES = 10.0
"""Number of time constants `RestGains.time_s` after which the initial torque has decayed."""
_POSES = 100
"""Number of poses at which the dynamics of an arm are evaluated."""
_LEAST_NM = 1e-300
"""Smallest divisor, to avoid division by zero."""
_MAX_PATTERNS = 64
"""Maximum number of combinations of joint directions to examine."""


class _RestBounds(NamedTuple):
    """Bounds on the motion of an arm that comes to rest after a stop.

    The bounds hold for a given joint speed at the beginning of the stop.

    Attributes:
        rest_s: Time within which the arm comes to rest, in s; infinite if its motors cannot
            hold it against gravity.
        bearable_share: Largest joint speed at which the motors can balance both gravity and
            Coriolis torques, divided by the initial speed.
        kinetic_j: Largest initial kinetic energy of the arm, in J.
        blend_j: Largest energy that the motors add to the arm, in J, because their torques fade
            out gradually instead of stopping immediately.
        peak_rad_s: Largest joint speeds that these energies permit, in rad/s, shape (n,).
    """

    rest_s: float
    bearable_share: float
    kinetic_j: float
    blend_j: float
    peak_rad_s: Array


class _ArmSamples(NamedTuple):
    """Inertias, Coriolis torques and gravity torques of an arm at many poses.

    The bounds for a stop are the worst values over these poses.

    Attributes:
        M: Inertia matrix at each pose, shape (poses, n, n).
        G: Absolute gravity torque at each pose, in N m, shape (poses, n).
        coriolis: Largest absolute Coriolis torque over all directions of joint motion, in N m,
            shape (poses, n).
    """

    M: Array
    G: Array
    coriolis: Array


def find_rest_bounds(scenario: Scenario, site: str) -> _RestBounds:
    """Bounds the time, energy and joint speeds of an arm that comes to rest.

    The user of a real arm needs to know how long and how fast the arm can move after a stop.

    Args:
        scenario: The scenario. The reaction of the site to missing samples (`on_stale.action`)
            must be "glide". The arm is then brought to rest by damping when its site stops.
        site: Name of the site whose arm stops. The joints are assumed to move initially as fast
            as the limits of the site allow.
    """
    spec = scenario.sites[site]
    setup = scenario.setup(site)
    joints = len(spec.q0_rad)
    speed = np.broadcast_to(setup.qd_limit_rad_s, joints).astype(float)
    limit_nm = np.broadcast_to(setup.tau_limit_nm, joints).astype(float)
    if spec.arm.urdf:
        samples = _sample_chain(scenario.arms[site], np.array(spec.q0_rad), speed)
    else:
        samples = _sample_planar_arm(spec.arm, speed)

    # Coriolis torques grow with the square of the speed, Eq. (7).
    beyond_gravity_nm = np.maximum(limit_nm - samples.G, 0.0)
    torque_shares = beyond_gravity_nm / np.maximum(samples.coriolis, _LEAST_NM)
    bearable_share = math.sqrt(float(torque_shares.min()))

    # energies at the beginning of the stop, Eq. (5)
    velocities = speed * _list_patterns(joints)
    kinetic_j = max(float(0.5 * v @ M @ v) for M in samples.M for v in velocities)
    damping = np.broadcast_to(setup.rest.damping, joints)
    blend_j = float((0.5 * limit_nm**2 / damping).sum()) / setup.rate_hz
    energy_j = kinetic_j + blend_j

    # A joint is fastest if it has all of this energy, Eq. (6).
    inverse_inertias = np.linalg.inv(samples.M)
    mobility = inverse_inertias.diagonal(axis1=1, axis2=2).max(axis=0)
    peak_rad_s = np.sqrt(2.0 * mobility * energy_j)

    rest_s = _bound_rest_time(
        setup=setup,
        speed=speed,
        limit_nm=limit_nm,
        samples=samples,
        energy_j=energy_j,
    )
    return _RestBounds(
        rest_s=rest_s,
        bearable_share=bearable_share,
        kinetic_j=kinetic_j,
        blend_j=blend_j,
        peak_rad_s=peak_rad_s,
    )


def _bound_rest_time(
    setup: SiteSetup, speed: Array, limit_nm: Array, samples: _ArmSamples, energy_j: float
) -> float:
    """Computes the time within which an arm comes to rest after a stop, Eq. (8), in s.

    Args:
        setup: Setup of the site.
        speed: Initial speed of each joint, in rad/s, shape (n,).
        limit_nm: Largest torque of each joint, in N m, shape (n,).
        samples: Dynamics of the arm.
        energy_j: Largest initial energy, in J.

    Returns:
        The time; infinite if the motors cannot hold the arm against gravity.
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
    adapts = setup.gains.is_adaptive and not setup.layout.task
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
    """Returns the combinations of joint directions, 1 or -1, in which an arm may move.

    The first joint always has direction 1, since the opposite combination has the same kinetic
    energy and the same Coriolis torques.

    Returns:
        Array of shape (patterns, joints), with at most `_MAX_PATTERNS` rows.
    """
    all_patterns = product((1.0, -1.0), repeat=joints - 1)
    patterns = islice(all_patterns, _MAX_PATTERNS)
    return np.array([(1.0, *pattern) for pattern in patterns])


def _draw_poses(model: ArmModel, q0: Array) -> Array:
    """Returns the start pose and random poses between the joint stops, shape (poses, n).

    A joint with no stop is drawn between -pi and pi.
    """
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
    """Computes the dynamics of the planar arm for all elbow angles.

    Uses Eqs. (2) to (5) and (24) of the paper. Inertia and Coriolis torques do not depend on
    the shoulder angle. The gravity torques are upper bounds over all poses.

    Args:
        arm: Table of the arm.
        speed: Speed of each joint, in rad/s, shape (2,).
    """
    a, b, c, first, second = arm.planar_links().theta()
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
    """Computes the dynamics of a chain at its start pose and at random poses.

    Friction is ignored, since it only dissipates energy.

    Args:
        model: Model of the arm.
        q0: Start pose, shape (n,).
        speed: Speed of each joint, in rad/s, shape (n,).
    """
    assert model.chain is not None
    frictionless = [joint._replace(viscous=0.0, coulomb=0.0) for joint in model.chain.joints]
    dynamics = ChainDynamics(model.chain._replace(joints=tuple(frictionless)), model.theta)
    # The first motion is none at all, so that its torque is that of gravity.
    velocities = np.vstack([np.zeros(len(q0)), speed * _list_patterns(len(q0))])
    still = np.zeros_like(velocities)

    inertias = []
    gravity_torques = []
    coriolis_torques = []
    for q in _draw_poses(model, q0):
        inertias.append(dynamics.find_inertia(q))
        poses = np.tile(q, (len(velocities), 1))
        torques = dynamics.compute_torque(poses, qd=velocities, v=velocities, a=still)
        G = torques[0]
        gravity_torques.append(np.abs(G))
        coriolis_torques.append(np.abs(torques - G).max(axis=0))
    return _ArmSamples(
        M=np.array(inertias),
        G=np.array(gravity_torques),
        coriolis=np.array(coriolis_torques),
    )
