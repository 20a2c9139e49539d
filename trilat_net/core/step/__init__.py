"""Computes one control period of an arm in eight stages, and whole simulations of all arms.

`Site.step` in `site_step` computes one period for any driver: a live session, a simulation or
the verification of a log. `fused_run` simulates all arms in one compiled call, for studies of
many runs. `row_fields` defines the arrays in which the state of an arm is stored.
"""
