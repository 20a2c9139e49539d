"""Computes the metrics of a recorded run, numbers that describe the run or a part of it.

They cover tracking, effort, energy, contact, force sharing, impedance, parameter error, network
and control loop.
"""
