"""Plans, runs and analyses experiments in which people operate the arms.

`protocol` plans the trials, `experiment_run` runs them and stores the results,
`movement_measures` computes measures of each trial, and `experiment_analysis` compares the
conditions statistically.
"""
