"""Compares control laws fairly, with gains tuned by the same procedure.

The gains of each law are tuned with the same number of attempts. Each law is then presented as
a Pareto front of error against effort: the gains for which no other gains of the law are better
in both. docs/reference/tuning-procedure.md describes the procedure, the formulas and the search
ranges.

Invariant:
    - Every law gets the same number of candidates, torque limit, duration, seeds and
      information about gravity, and its runs are classified in the same way.
    - The error between an arm and those that it follows does not rank laws by itself, because
      it is zero for arms that hang down together.
"""

from .tuning_plan import TuningPlan, TuningResult, plan_tuning

__all__ = ["TuningPlan", "TuningResult", "plan_tuning"]
