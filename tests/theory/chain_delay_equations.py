"""The delay-differential equations of arms that are chains, on Pinocchio's dynamics.

Nothing is imported from `trilat_net.core`. `python -m tests.theory.chain_delay_equations`
writes `chain_motion.json`: the motion of `PUSHED` at `TIMES_S`, for tests without Pinocchio.
"""

import json
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from tests.core.chain_references import Array
from tests.core.make_chain_references import build_model, regressor
from tests.theory.chain_motion import PATH, TIMES_S, pushed_chains
from tests.theory.delay_equations import DelayEquations, common_terms
from trilat_net.scenario import Scenario
from trilat_net.scenario.urdf import read_urdf


@dataclass
class ChainEquations(DelayEquations):
    """Eq. (6), (8)-(10), (13), (15) for chains; the drives' inertia is known to the law."""

    model: pin.Model = None
    armature: Array | None = None

    def accelerate(
        self, q: Array, qd: Array, e: Array, ed: Array, r: Array, estimate: Array, pushed: Array
    ) -> tuple[Array, Array]:
        qdd = np.empty_like(q)
        gradient = np.empty_like(estimate)
        v = -self.Lambda * e
        a = -self.Lambda * ed
        for i in range(len(q)):
            Y = regressor(self.model, q[i], qd[i], v[i], a[i])
            tau = (
                Y @ estimate[i]
                + self.armature * a[i]
                - self.Kp * r[i]
                - self.Kd * ed[i]
                + pushed[i]
            )
            data = self.model.createData()
            bias = pin.rnea(self.model, data, q[i], qd[i], np.zeros(self.joints))
            M = np.triu(pin.crba(self.model, data, q[i]))
            M = M + np.triu(M, 1).T + np.diag(self.armature)
            qdd[i] = np.linalg.solve(M, tau - bias)
            gradient[i] = Y.T @ r[i]
        return qdd, gradient


def chain_equations(scenario: Scenario) -> ChainEquations:
    """Returns the equations of a scenario whose arms are one file, with gravity down along -z."""
    arm, *others = [spec.arm for spec in scenario.sites.values()]
    assert all(other == arm for other in others)
    chain = read_urdf(scenario.urdf[arm.urdf], arm.base, arm.tip)
    model = build_model(chain)
    model.gravity.linear = np.array([0.0, 0.0, -arm.g_m_s2])
    theta = np.concatenate([joint.inertia for joint in chain.joints])
    armature = np.zeros(len(chain.joints)) + arm.armature_kg_m2
    terms = common_terms(scenario)
    return ChainEquations(theta=theta, g=arm.g_m_s2, model=model, armature=armature, **terms)


def main() -> None:
    """Writes the motion that `chain_motion` reads."""
    exact = chain_equations(pushed_chains()).solve(float(TIMES_S[-1]))
    q = exact.at(TIMES_S)[..., : exact.joints]
    PATH.write_text(
        json.dumps({"source": f"Pinocchio {pin.__version__}, DOP853", "q": q.tolist()}) + "\n"
    )


if __name__ == "__main__":
    main()
