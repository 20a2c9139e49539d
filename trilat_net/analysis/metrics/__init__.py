"""Metrics of a run.

Tracking, effort, energy, contact, force sharing, impedance, parameter error, network and loop.
"""
