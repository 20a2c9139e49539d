"""Clocks, messages, the bus, and how the members of a session find each other and agree on an
epoch.
"""
