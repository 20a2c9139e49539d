"""Twins: repeated runs with a small push, and whether the push grows."""
