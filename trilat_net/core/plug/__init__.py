"""Calls control laws and models that are not part of the compiled control loop.

Users write such laws in Python, and so are many of the built-in laws. `compiled_law` compiles a
law with Numba, and `user_law` calls a law in plain Python.
"""
