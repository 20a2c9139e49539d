"""Names of `trilat_studies.trials`, which files of users import from here."""

from trilat_studies.trials import Trial, TrialReport, TrialResult, check, run_trials, trials

__all__ = ["Trial", "TrialReport", "TrialResult", "check", "run_trials", "trials"]
