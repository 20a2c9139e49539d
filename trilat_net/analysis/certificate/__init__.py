"""Judges from the log of a run whether the run was stable, and gives the reasons.

The resulting stability certificate is based on the stability theorem of the paper, which states
that an energy function V of all arms never rises unless an operator supplies energy. The
package checks that the conditions of the theorem hold, computes V from the log, and checks that
every change of V has a known cause.
"""
