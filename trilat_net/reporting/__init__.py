"""Figures, the report page, text and exports.

Invariant: matplotlib is imported here and in the figures of `studies`, nowhere else.
"""
