"""Experiments with people: protocols, tasks, trials, measures and statistics."""
