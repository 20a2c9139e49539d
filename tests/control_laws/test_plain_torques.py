"""The laws that the kernel computes: their plain torques equal the kernel's, bit for bit.

The planar arm is compared at random states. A chain adds the same terms in another order, so it
is compared twice: with numbers whose sums are exact in any order, bit for bit, and at random
states within rounding.
"""

from typing import Any

import numpy as np
import pytest

from trilat_net.core.arms import chain_stages, two_link_arm, two_link_stages
from trilat_net.core.arms.chain import friction_torque, inverse_dynamics
from trilat_net.core.step.site_arrays import SiteArrays
from trilat_net.core.step.vectors import Array
from trilat_net.scenario import load_scenario
from trilat_net.scenario.laws import BUILT_IN

STATES = 200
NO_LIMIT = 1e300
PLANAR = "paper"
CHAIN = "six_joints"
SITE = "m1"
"""The law of this site is compared, in a scenario with planar arms and in one with chains."""
ADAPTIVE = {"Lambda": 1.5, "Kp": 2.25, "Kd": 3.5, "Gamma": 0.75, "theta_hat0": 0.0}
BOX = {**ADAPTIVE, "theta_low": -0.5, "theta_high": 0.5}
GAINS = {
    "p_d": {"K": 12.5, "d": 4.25},
    "pd_d": {"K": 12.5, "Kd": 1.75, "d": 4.25},
    "lee_spong": {"K": 12.5, "Kd": 1.75, "P_e": 0.5},
    "p_f": {"K": 12.5, "d": 4.25, "k_f": 0.375},
    "adaptive": ADAPTIVE,
    "adaptive_box": BOX,
    "adaptive_robust": {**BOX, "rho_nm": 0.5, "width_rad_s": 0.25},
}
"""Per law of the kernel its gains, for the first joint or parameter."""
LEARNING = ("adaptive", "adaptive_box", "adaptive_robust")
EXACT = [name for name in GAINS if name != "lee_spong"]  # its K T_max is rounded


def make_law_and_arrays(name: str, scenario: str) -> tuple[Any, SiteArrays]:
    """Returns a law with a different gain for each joint, and the arrays of its site."""
    setup = load_scenario(scenario).setup(SITE)
    gains: dict[str, tuple[float, ...]] = {}
    for key, first in GAINS[name].items():
        is_parameter = key.startswith(("theta", "Gamma"))
        count = setup.layout.parameters if is_parameter else setup.layout.joints
        step = 0.0 if key.startswith("theta") else 0.125
        gains[key] = tuple(first + step * n for n in range(count))
    law: Any = BUILT_IN[name].Settings(**gains)
    setup = setup._replace(gains=law.gains(setup.theta), tau_limit_nm=NO_LIMIT)
    return law, SiteArrays.build(setup, pages=8)


def put_random_state(row: Any, rng: np.random.Generator, *, exact: bool = False) -> None:
    """Writes a random state; with `exact`, sums and products of its numbers need no rounding."""
    for name in ("q", "qd", "q_des", "qd_des", "felt", "theta_hat", "Yr"):
        values = rng.uniform(-2.0, 2.0, row[name].shape)
        row[name] = np.round(32.0 * values) / 32.0 if exact else values


def compute_plain_torque(
    law: Any, row: Any, Y: Array, gravity: Array, joint_friction: Array | None = None
) -> Array:
    """Returns the torque by the law's own file; Y is the regressor for the estimate in the row."""
    n = len(gravity)
    e, ed, r, qd = (np.array(row[name][:n]) for name in ("e", "ed", "r", "qd"))
    name = law.tag
    if name == "adaptive_robust":
        friction = np.zeros(n) if joint_friction is None else joint_friction
        torque = law.compute_torque(Y, row["theta_hat"], r, ed, friction)
    elif name in LEARNING:
        torque = law.compute_torque(Y, row["theta_hat"], r, ed)
    elif name == "p_d":
        torque = law.compute_torque(gravity, e, qd)
    elif name == "p_f":
        torque = law.compute_torque(gravity, e, qd, np.array(row["felt"][:n]))
    else:
        torque = law.compute_torque(gravity, e, ed, qd)
    return np.asarray(torque)


@pytest.mark.parametrize("name", GAINS)
def test_planar_arm_has_the_plain_torque(name: str) -> None:
    law, arrays = make_law_and_arrays(name, PLANAR)
    row = arrays.site[0]
    rng = np.random.default_rng(1)
    for _ in range(STATES):
        put_random_state(row, rng)
        two_link_stages.update_errors(row)
        two_link_stages.update_torque(row)
        gravity = np.array(two_link_arm.gravity(row["known"], row["g"], row["q"]))
        plain = compute_plain_torque(law, row, np.array(row["Y"]), gravity)
        assert plain.tolist() == row["tau"].tolist()


@pytest.mark.parametrize("name", LEARNING)
@pytest.mark.parametrize("scenario", [PLANAR, CHAIN])
def test_estimates_advance_as_in_the_plain_law(name: str, scenario: str) -> None:
    law, arrays = make_law_and_arrays(name, scenario)
    stages = chain_stages if scenario == CHAIN else two_link_stages
    row = arrays.site[0]
    rng = np.random.default_rng(2)
    for _ in range(STATES):
        put_random_state(row, rng)
        Yr = np.array(row["Yr"])
        plain = law.advance_estimate(np.array(row["theta_hat"]), Yr, 0.05)
        stages.advance_estimate(row, 0.05, Yr)
        assert plain.tolist() == row["theta_hat"].tolist()


@pytest.mark.parametrize("name", EXACT)
def test_chain_has_the_plain_torque_of_exact_numbers(name: str) -> None:
    """The model's torque is zero here: no gravity, no estimate, no friction, no drives."""
    law, arrays = make_law_and_arrays(name, CHAIN)
    row = arrays.site[0]
    chain = arrays.chain
    assert chain is not None
    for field in ("armature_kg_m2", "viscous", "coulomb"):
        chain[field] = 0.0
    row["known"] = 0.0
    n = len(chain)
    rng = np.random.default_rng(3)
    for _ in range(STATES):
        put_random_state(row, rng, exact=True)
        row["theta_hat"] = 0.0
        chain_stages.place_chain(row, chain)
        chain_stages.update_errors(row, chain)
        chain_stages.update_torque(row, chain)
        Y = np.zeros((n, len(row["theta_hat"])))
        plain = compute_plain_torque(law, row, Y, np.zeros(n))
        assert plain.tolist() == row["tau"].tolist()


@pytest.mark.parametrize("name", GAINS)
def test_chain_has_the_plain_torque_within_rounding(name: str) -> None:
    law, arrays = make_law_and_arrays(name, CHAIN)
    row = arrays.site[0]
    chain = arrays.chain
    assert chain is not None
    chain["coulomb"] = 0.75
    n = len(chain)
    model_torque = np.zeros(n)
    gravity = np.zeros(n)
    rng = np.random.default_rng(4)
    for _ in range(STATES):
        put_random_state(row, rng)
        chain_stages.place_chain(row, chain)
        chain_stages.put_gravity(row, chain, row["known"], gravity)
        chain_stages.update_errors(row, chain)
        chain_stages.update_torque(row, chain)
        kernel = row["tau"].tolist()
        inverse_dynamics(chain, row["theta_hat"], row["v"], row["a"], model_torque)
        friction = np.array([friction_torque(chain[i], row["v"][i]) for i in range(n)])
        # the recursion computes Y theta_hat without Y: a regressor with one column stands for it
        Y = np.zeros((n, len(row["theta_hat"])))
        Y[:, 0] = model_torque / row["theta_hat"][0]
        plain = compute_plain_torque(law, row, Y, gravity, friction)
        scale = 1.0 + np.abs(model_torque).max() + np.abs(gravity).max()
        assert plain == pytest.approx(kernel, rel=1e-12, abs=1e-12 * scale)
