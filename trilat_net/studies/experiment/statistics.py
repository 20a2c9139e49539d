"""Names of `trilat_people.experiment.statistics`, which files of users import from here."""

from trilat_people.experiment.statistics import (
    Comparison,
    ConditionMean,
    MixedEffect,
    MixedModel,
    SimulatedPower,
    average_trials,
    bootstrap_interval,
    compare_conditions,
    correct_holm,
    find_least_number,
    fit_mixed_model,
    power,
    simulate_power,
    summarise_conditions,
)

__all__ = [
    "Comparison",
    "ConditionMean",
    "MixedEffect",
    "MixedModel",
    "SimulatedPower",
    "average_trials",
    "bootstrap_interval",
    "compare_conditions",
    "correct_holm",
    "find_least_number",
    "fit_mixed_model",
    "power",
    "simulate_power",
    "summarise_conditions",
]
