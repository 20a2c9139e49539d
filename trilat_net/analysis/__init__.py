"""A log in numbers: delivery, delays, timeline, health, summary, certificate and metrics.

Invariant: nothing here draws, formats or prints; `reporting` does.
"""
