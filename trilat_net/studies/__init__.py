"""Studies of many runs: trials, sweeps, tuning, benchmarks, and experiments with people.

Invariant:
    - A study is a function of its plan. The number of worker processes, and the order in which
      they finish, do not change any result.
"""
