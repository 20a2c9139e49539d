"""Lets people operate the arms: web page, input devices, and experiments with participants.

Adds commands such as `trilat live` and `trilat experiment run` to trilat-net. Distributed
separately, since simulations do not need it.
"""
