"""Lets people operate the arms: web page, input devices, and experiments with participants.

The package adds commands such as `trilat live` and `trilat experiment run` to trilat-net. It is
a distribution of its own, because simulations need none of it.
"""
