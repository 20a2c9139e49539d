"""Compares control laws fairly, at gains that the same procedure has tuned.

The gains of each law are tuned with the same number of attempts. Each law is then shown as a
Pareto front of error against effort: the gains for which no other gains of the law are better
in both. docs/fair-comparison.md has the procedure, the formulas and the search ranges.

Invariant:
    - Every law gets the same number of candidates, the same torque limit, duration, seeds,
      information about gravity, and classification of its runs.
    - The error e of a site against its peers does not rank laws by itself, because arms that
      hang down together have e = 0.
"""

from .tuning_plan import TuningPlan, TuningResult, plan_tuning

__all__ = ["TuningPlan", "TuningResult", "plan_tuning"]
