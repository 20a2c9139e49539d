"""Fair comparison of control laws.

The gains of each law are tuned by the same procedure. Each law is then shown as a Pareto front
of error against effort. docs/fair-comparison.md has the procedure, the formulas and the search
ranges.

Invariant:
    - Every law gets the same number of candidates, torque clamp, horizon, seeds, gravity
      information and classification.
    - The error e alone does not rank laws: arms that hang together have e = 0.
"""

from .tuning_plan import TuningPlan, TuningResult, plan_tuning

__all__ = ["TuningPlan", "TuningResult", "plan_tuning"]
