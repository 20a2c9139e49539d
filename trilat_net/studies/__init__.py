"""Experiments with people, and former places of names of the package trilat-studies."""
