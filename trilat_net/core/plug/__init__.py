"""Calls control laws and models that are not part of the compiled control loop.

Such laws are written in Python, either by users or as one of the built-in laws. `compiled_law`
compiles a law with Numba, and `user_law` calls a law in plain Python.
"""
