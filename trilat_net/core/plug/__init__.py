"""Calls control laws and models that are not a part of the compiled control loop.

Users write such laws in Python, and many built-in laws are written in the same way.
`compiled_law` compiles a law with Numba, and `user_law` calls a law in plain Python.
"""
