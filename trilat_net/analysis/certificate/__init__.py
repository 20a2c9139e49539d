"""Stability certificate of a log.

The theorem's premises, the corrected functional, its energy balance, the verdict.
"""
