"""The built-in control laws, one per file.

Invariant:
    - File, class and scenario name of a law correspond: `four_channel.py` holds `FourChannel`,
      and a scenario writes law = "four_channel".
    - A law is written as a user writes one (docs/own-controller.md). Its `torque` is compiled:
      it loops over numbers and creates no lists.
    - Other modules find the laws by listing this folder, see `scenario.laws`.
"""
