"""Simulates the network between arms: delays, losses, and when received samples are used.

`delay` and `channel` compute when the simulated network delivers a sample, and `link` holds the
sample until then. `dominance` and `lost_peers` compute the position that an arm follows from
the newest samples.
"""
