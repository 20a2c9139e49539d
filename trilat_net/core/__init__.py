"""Contains the core, which computes one tick (period) of the control loop of one site.

A site is a process that runs one arm. The core comprises the arms, the control laws, the links
between sites, and the step of a site. README.md in this folder describes the stages of a tick,
the state of a site, and each file.

Invariant:

- Nothing in this package reads a clock, opens a socket or logs. All random numbers are seeded
  by the scenario, the file that describes an experiment. Only `jit` and `plugged` use files,
  for compiled code.
- The package depends on the standard library, NumPy, Numba, `errors` and `process` alone.
"""
