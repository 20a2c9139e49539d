"""Computes a control period of one arm in eight stages, or simulates whole runs of all arms.

Every driver (a live session, a simulation, or the verification of a log) computes a control
period by calling `Site.step` in `site_step`. For studies with many runs, `fused_run` simulates
all arms in one compiled call. The arrays that store the state of an arm are defined in
`row_fields`.
"""
