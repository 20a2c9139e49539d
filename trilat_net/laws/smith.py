"""Spring coupling of a master and a slave with a Smith predictor.

A Smith predictor removes a delay from a control loop: the controller follows an undelayed model
of the remote side, and corrects the model with the delayed difference from the true motion.
Here the predictor extends P+d, which consists of a spring between the arms and a damper at each
arm.

    slave    tau = G - K (q_s - q_m(t - T)) - d qd_s
             sends w = q_s - x, where the model x is driven by q_m(t - T)
    master   tau = G - K (q_m - x - w(t - T)) - d qd_m, where the model x is driven by q_m
    model    inertia x'' = K (q_m - x) - d x'

Here q_m, q_s, qd_m and qd_s are the positions and velocities of master and slave, tau is the
torque of an arm and G its gravity torque, T is the delay, K a stiffness and d a damping
coefficient.
Because both sites run the same model, no past values need to be stored, however long the delay
is. The signal w is the part of the slave's motion that the model does not predict, for example
in contact. The master is the site with `predicts` = true.

Invariant:
    - The model moves like an arm whose torque is held constant over each tick (scheme
      `digital`).
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core import Array, Gains, Law, LawContext, LawInput, compiled
from ..fields import NotNegative, NotNegativeJoints, PositiveJoints
from .conditions import LawSituation, LinearForm, LinearSituation, StabilityCondition
from .interface import DAMPING, INERTIA, STIFFNESS, ControlLaw, TuningSite


@compiled
class Smith(ControlLaw):
    """Couples a master and a slave with springs and a predictor that removes the delay.

    A damper brakes each arm. The slave is pulled towards the delayed position of the master.
    The master is pulled towards the position of an undelayed model of the slave, corrected by
    the delayed difference between the slave and the model. The equations are given in the
    module docstring.

    Source: Smith, "Closer control of loops with dead time", Chemical Engineering Progress 53,
    1957 (cited from memory).

    Attributes:
        K: Stiffness per joint, N m/rad.
        d: Damping of the arm's motion, per joint, N m s/rad.
        inertia: Inertia of the slave's model, per joint, kg m^2. K, d and inertia must be the
            same at both sites.
        predicts: True for the master.
        gravity: Ratio of the compensated to the true gravity torque; 1 is exact.
    """

    K: PositiveJoints = (10.0,)
    d: NotNegativeJoints = (3.0,)
    inertia: PositiveJoints = (1.0,)
    predicts: bool = False
    gravity: NotNegative = 1.0

    sends: ClassVar[dict[str, Any]] = {"w": {"unit": "rad", "length": "joints"}}
    remembers: ClassVar = ("x", "xd")
    tune: ClassVar = {"K": STIFFNESS, "d": DAMPING, "inertia": INERTIA}
    sites: ClassVar = 2
    needs_theta: ClassVar = True

    def begin(self, facts: LawContext) -> None:
        """Prepares the law before a run by creating the state of the slave's model.

        The model predicts the undelayed motion of the slave. Its state consists of the position
        x, which is initialised in the first tick, and the velocity xd.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
        """
        self.x = [0.0] * facts.joints
        self.xd = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Computes the torque of one tick, and advances the model of the slave.

        Master and slave run the same model of the slave's motion. The slave sends the
        difference w between its position and the position of the model. The master is pulled
        towards the position of its model plus the received w.

        Args:
            now: Inputs and outputs of the law in this tick. The torque is written into
                `now.tau`.
        """
        h = now.h_s
        for i in range(now.joints):
            K = self.K[i]
            d = self.d[i]
            q = now.q[i]
            peer_q = now.peers[0].q[i]
            if now.k == 0:
                self.x[i] = peer_q if self.predicts else q
            x = self.x[i]
            if self.predicts:
                master_q = q
                goal = x + now.received[0].w[i]
                now.to_all.w[i] = 0.0
            else:
                master_q = peer_q
                goal = peer_q
                now.to_all.w[i] = q - x

            gravity = self.gravity * now.gravity[i]
            spring = K * (q - goal)
            damper = d * now.qd[i]
            now.tau[i] = gravity - spring - damper

            xd = self.xd[i]
            model_spring = K * (master_q - x)
            model_damper = d * xd
            model_torque = model_spring - model_damper
            acceleration = model_torque / self.inertia[i]
            self.x[i] += h * xd + 0.5 * h * h * acceleration
            self.xd[i] += h * acceleration

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the gains of this law's spring and damper for the linear analysis.

        At the slave, the gains contain the stiffness K and the damping d. At the master, they
        contain only d, because the master's spring acts on the model of the slave, which
        `linear_form` adds.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        K = (0.0,) if self.predicts else self.K
        # The gravity torque is linear in the parameters: scaled parameters scale the torque.
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, K=K, d=self.d, known=known)

    def linear_form(self, situation: LinearSituation) -> LinearForm | None:
        """Returns the model of the slave and its effect on the law, for the linear analysis.

        The model is a mass on a spring and a damper, driven by the position of the master. Its
        states are the position x and the velocity xd. The torque of the master depends on x,
        and the slave sends the master the difference between its position and x.

        Args:
            situation: This arm and the only other arm.
        """
        (peer,) = situation.peers
        K = np.array(self.K)
        d = np.array(self.d)
        inertia = np.array(self.inertia)
        master_q = "q" if self.predicts else "q_des"
        joints = len(situation.inertia)
        form = LinearForm(joints, ("x", "xd"))
        form.add("x", "xd", 1.0)
        form.add("xd", "x", -K / inertia)
        form.add("xd", "xd", -d / inertia)
        form.add("xd", master_q, K / inertia)
        if self.predicts:
            form.add("tau", "q", -K)
            form.add("tau", "x", K)
            form.add("tau", ("from", peer), K)
        else:
            sent = ("to", peer)
            form.add(sent, "q", 1.0)
            form.add(sent, "x", -1.0)
        return form

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether the predictor removes the delay from the control loop.

        The setting `predicts` must be true at exactly one of the two arms, and K, d and inertia
        must be equal at both arms. Otherwise the condition is not satisfied. If both
        requirements are satisfied, the condition is undecided (`holds` is None): the loop is
        stable while the slave moves freely, but the model does not include contacts.

        Args:
            situation: The two arms and their laws.
        """
        laws = situation.laws
        predicting = [law for law in laws if getattr(law, "predicts", False)]
        if len(predicting) != 1:
            return StabilityCondition(False, "one of the two sites has predicts = true")
        for law in laws:
            for key in ("K", "d", "inertia"):
                gain = getattr(law, key, None)
                if gain != getattr(self, key):
                    text = "K, d and inertia must be equal at both sites"
                    return StabilityCondition(False, text)
        text = (
            "while the slave moves freely with the inertia of the model, the loop is stable as "
            "without delay (d > 0); the model has no contact and no change of inertia"
        )
        return StabilityCondition(None, text)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        The setting `predicts` is true for the master, which predicts the motion of the slave
        with a model, and false for the slave.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        return {**gains, "predicts": site.role == "master", "gravity": site.gravity}
