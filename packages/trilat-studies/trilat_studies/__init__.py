"""Studies of many runs: trials, sweeps, tuning, benchmarks, and an environment for training.

The package belongs to trilat-net, and registers its commands and functions there by the entry
points of its pyproject.toml: `trilat sweep` and `trilat_net.sweep`, for example.

Invariant:
    - A study is a function of its plan. The number of worker processes, and the order in which
      they finish, do not change any result.
"""
