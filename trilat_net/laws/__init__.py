"""The built-in control laws, one a file: a file, its class and its name in a scenario are one.

Invariant: a law is written as a user writes one (docs/own-controller.md), `torque` for a
compiler: loops over numbers, no lists made. What else knows laws finds them here, see
`catalogue`.
"""
