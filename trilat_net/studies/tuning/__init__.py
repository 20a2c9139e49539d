"""Fair comparison of control laws.

Each law is tuned by one written procedure, and shown as a front of error against effort.

Invariant: every law gets the same number of candidates, torque clamp, horizon, seeds, gravity
information and classification. e alone ranks no law: arms that hang together have e = 0.

docs/fair-comparison.md holds the procedure, the formulas and the table of search ranges.
"""

from .tuning_plan import TuningPlan, TuningResult, plan_tuning

__all__ = ["TuningPlan", "TuningResult", "plan_tuning"]
