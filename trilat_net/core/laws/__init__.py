"""Built-in control laws in the form of a user's law, one a module, see docs/own-controller.md.

Invariant: they use nothing that a law from outside cannot use; `torque` of each is written for a
compiler: loops over numbers, no lists made.
"""
