"""Contains the built-in control laws, one per file.

A control law computes the torque of an arm from the motion of the arm and of its peers.

Invariant:
    - File, class and scenario name of a law correspond: `four_channel.py` holds `FourChannel`,
      and a scenario, the file that describes an experiment, states law = "four_channel".
    - A built-in law is written as a user writes one (docs/extend/own-controller.md). Its method
      `torque` is compiled, so it loops over numbers and creates no lists.
    - Other modules find the laws by listing this folder, see `scenario.laws`.
"""
