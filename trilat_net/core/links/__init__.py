"""Simulates the network between arms: delays, losses, and the use of received states.

In each control period, an arm sends a sample (its state) to the others. `delay` and `channel`
compute when the simulated network delivers the sample, and `link` keeps the sample until then.
`dominance` and `lost_peers` compute the position that an arm follows from the newest samples.
"""
