"""Studies that consist of many runs: sweeps, gain tuning, benchmarks and policy training.

This separate distribution adds commands such as `trilat sweep` and functions such as
`trilat_net.sweep`. It registers them through the entry points in its pyproject.toml.

Invariant:
    - The result of a study depends only on its plan. The number of worker processes and the
      order in which they finish have no influence.
"""
