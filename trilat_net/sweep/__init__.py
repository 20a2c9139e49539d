"""Stability maps: one scenario over a plane of its keys, in virtual time, on all cores."""
