"""Clocks, messages, the bus, and the start of a session.

The members of a session find each other over the bus and agree on an epoch.
"""
