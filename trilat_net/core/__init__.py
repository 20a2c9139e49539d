"""Numbers in, numbers out: the arm, the control law, the links and the one step of a site.

Nothing in here reads a clock, opens a file or a socket, logs, or draws a random number that the
scenario did not seed. It needs the standard library, NumPy and Numba, and no other part of the project.
"""
