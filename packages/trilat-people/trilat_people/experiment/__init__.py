"""Plans, runs and evaluates experiments with people who operate the arms.

`protocol` plans the trials, `experiment_run` runs them and stores their results,
`movement_measures` computes measures of each trial, and `experiment_analysis` compares the
conditions of the experiment statistically.
"""
