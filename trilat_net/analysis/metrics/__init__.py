"""Computes metrics that describe a recorded run, such as the RMS error or the largest torque.

The metrics cover tracking, effort, energy, contact, force sharing, impedance, parameter error,
network and control loop. To add a metric, decorate a function in a module of this folder with
`measures.measures`.
"""
