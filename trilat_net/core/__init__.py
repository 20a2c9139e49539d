"""The core: it computes one tick of one site, from numbers to numbers.

It contains the arms, the control laws, the links, and the step of a site. README.md in this
folder describes the stages of a tick, the state of a site, and each file.

Invariant:

- Nothing in this package reads a clock, opens a socket, logs, or draws a random number that the
  scenario does not seed. Only `jit` and `plugged` use files, for compiled code.
- It depends on the standard library, NumPy, Numba, `errors` and `process` alone.
"""
