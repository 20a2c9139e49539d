"""Computes numbers from the log of a run: delays, timeline, stability certificate and metrics.

A log contains a record for every tick of every site, the process that runs one arm.

Invariant:
    - Nothing in this package draws, formats or prints. The package `presentation` does so.
"""
