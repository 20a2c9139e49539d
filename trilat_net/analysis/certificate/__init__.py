"""Judges from the log of a run whether it was stable, and gives the reasons.

The judgement is called a stability certificate, and rests on the stability theorem of the
paper. The theorem says that an energy function V of all arms never rises, unless an operator
supplies energy. The package checks whether the conditions of the theorem hold, computes V from
the log, and checks that every change of V has a known cause.
"""
