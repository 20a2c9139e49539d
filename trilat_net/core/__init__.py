"""Numbers in, numbers out: the arm, the control laws, the links, and the one step of a site.

Invariant: nothing in this package reads a clock, opens a file or a socket, logs, or draws a
random number that the scenario does not seed. It depends on the standard library, NumPy, Numba
and `errors`.
"""
