"""Lets people operate the arms: web page, input devices, and experiments with participants.

The package adds commands such as `trilat live` and `trilat experiment run` to trilat-net. It is
a separate distribution, because simulations do not need it.
"""
