"""Checks with a recorded run that the stability theorem of the paper holds for it.

The certificate checks the premises (conditions) of the theorem, evaluates the energy function V
of its proof, verifies that the energy balance of the records is closed, and states a verdict.
"""
