"""Compares many runs: parameter sweeps, tuning of gains, benchmarks, and training of policies.

The package adds commands such as `trilat sweep`, and functions such as `trilat_net.sweep`. It
is a distribution of its own, which registers them by the entry points of its pyproject.toml.

Invariant:
    - The result of a study depends only on its plan. The number of worker processes, and the
      order in which they finish, have no influence.
"""
