"""Makes `chain_references.json` anew with Pinocchio: `python -m tests.core.make_chain_references`.

It needs the packages of `requirements/robots.lock`. A chain is rebuilt joint by joint as Pinocchio's model.
"""

import json
import math

import numpy as np
import pinocchio as pin

from tests.core.chain_references import ARMS, PATH, Array, to_chain
from trilat_net.scenario.urdf import UrdfChain, read_urdf

STATES = 3
SEED = 14


def build_model(chain: UrdfChain) -> pin.Model:
    """Returns a chain as a model of Pinocchio, with its end link as the last frame."""
    model = pin.Model()
    at = 0
    for joint in chain.joints:
        moving = (
            pin.JointModelRevoluteUnaligned
            if joint.kind == "revolute"
            else pin.JointModelPrismaticUnaligned
        )
        placement = pin.SE3(np.array(joint.rotation), np.array(joint.origin_m))
        at = model.addJoint(at, moving(np.array(joint.axis)), placement, joint.name)
        body = pin.Inertia.FromDynamicParameters(np.array(joint.inertia))
        model.appendBodyToJoint(at, body, pin.SE3.Identity())
    tip = pin.SE3(np.array(chain.tip_rotation), np.array(chain.tip_origin_m))
    model.addFrame(pin.Frame(chain.tip, at, tip, pin.FrameType.BODY))
    return model


def read_parameters(chain: UrdfChain) -> Array:
    return np.concatenate([joint.inertia for joint in chain.joints])


def regressor(model: pin.Model, q: Array, qd: Array, v: Array, a: Array) -> Array:
    """Returns Y(q, qd, v, a) of two velocities from the regressor of one, by polarisation of
    its quadratic term.
    """
    still = np.zeros(model.nv)

    def Y(qd: Array, a: Array) -> Array:
        flat = pin.computeJointTorqueRegressor(model, model.createData(), q, qd, a)
        return flat.reshape(model.nv, -1).copy()  # of one joint it is a vector

    return Y(still, a) + 0.25 * (Y(qd + v, still) - Y(qd - v, still))


def compute_answer(
    model: pin.Model, chain: UrdfChain, state: dict[str, Array]
) -> dict[str, Array]:
    """Returns Pinocchio's results for a state."""
    model.gravity.linear = state["gravity"]
    data = model.createData()
    q = state["q"]
    qd = state["qd"]
    tip = model.nframes - 1
    Y = regressor(model, q, qd, state["v"], state["a"])
    inertia = np.triu(pin.crba(model, data, q).reshape(model.nv, model.nv))
    jacobian = pin.computeFrameJacobian(model, data, q, tip, pin.LOCAL_WORLD_ALIGNED)
    pin.framesForwardKinematics(model, data, q)
    pose = data.oMf[tip].copy()
    return {
        "inverse_dynamics": Y @ read_parameters(chain),
        "regressor_transpose_r": Y.T @ state["r"],
        "forward_dynamics": pin.aba(model, model.createData(), q, qd, state["tau"]).copy(),
        "inertia": inertia + np.triu(inertia, 1).T,
        "tip_position": pose.translation,
        "tip_rotation": pose.rotation,
        "jacobian": jacobian.reshape(6, model.nv),
    }


def random_rotation(random: np.random.Generator) -> Array:
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return turn * np.sign(np.linalg.det(turn))


def random_body(random: np.random.Generator) -> Array:
    """Returns ten parameters of eight point masses, which are physical for any draw."""
    masses = random.uniform(0.05, 0.5, 8)
    places = random.normal(0.0, 0.15, (8, 3)) + random.normal(0.0, 0.2, 3)
    x, y, z = places.T
    moments = (y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y)
    return np.array(
        [masses.sum(), *(masses @ places), *(masses @ moment for moment in moments)]
    )


def random_chain(random: np.random.Generator, n: int, sliders: tuple[int, ...] = ()) -> dict:
    """Returns a chain of plain numbers, with axes in any direction."""
    joints = []
    for i in range(n):
        axis = random.normal(size=3)
        joints.append(
            {
                "name": f"joint{i + 1}",
                "link": f"link{i + 1}",
                "kind": "prismatic" if i in sliders else "revolute",
                "axis": (axis / math.sqrt(axis @ axis)).tolist(),
                "rotation": random_rotation(random).tolist(),
                "origin_m": random.normal(0.0, 0.3, 3).tolist(),
                "inertia": random_body(random).tolist(),
            }
        )
    return {
        "joints": joints,
        "tip_rotation": random_rotation(random).tolist(),
        "tip_origin_m": random.normal(0.0, 0.2, 3).tolist(),
    }


def shipped_chain(name: str) -> dict:
    chain = read_urdf((ARMS / f"{name}.urdf").read_text())
    kept = ("name", "link", "kind", "axis", "rotation", "origin_m", "inertia")
    return {
        "joints": [{key: getattr(joint, key) for key in kept} for joint in chain.joints],
        "tip_rotation": chain.tip_rotation,
        "tip_origin_m": chain.tip_origin_m,
    }


def random_state(random: np.random.Generator, n: int, weight: bool) -> dict[str, Array]:
    """Returns a state; its gravity points down, or anywhere."""
    gravity = np.array([0.0, 0.0, -9.81]) if weight else random.normal(0.0, 6.0, 3)
    spread = {"q": 1.5, "qd": 2.0, "v": 1.0, "a": 3.0, "tau": 5.0}
    drawn = {key: random.normal(0.0, size, n) for key, size in spread.items()}
    return {"gravity": gravity, "r": drawn["qd"] - drawn["v"]} | drawn


def main() -> None:
    random = np.random.default_rng(SEED)
    chains = {
        "random1": random_chain(random, 1),
        "random2": random_chain(random, 2),
        "random3": random_chain(random, 3, sliders=(1,)),
        "arm6": shipped_chain("arm6"),
        "arm7": shipped_chain("arm7"),
        "random12": random_chain(random, 12, sliders=(6,)),
    }
    for entry in chains.values():
        chain = to_chain(entry)
        model = build_model(chain)
        entry["states"] = []
        for i in range(STATES):
            state = random_state(random, model.nv, weight=i == 0)
            whole = state | compute_answer(model, chain, state)
            entry["states"].append({key: value.tolist() for key, value in whole.items()})
    references = {
        "source": f"Pinocchio {pin.__version__}, tests/core/make_chain_references.py",
        "chains": chains,
    }
    PATH.write_text(
        json.dumps(references, separators=(",", ":")).replace('},{"gravity"', '},\n{"gravity"')
        + "\n"
    )


if __name__ == "__main__":
    main()
