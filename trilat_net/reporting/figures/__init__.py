"""Figures of a log: one function per figure, and their registry."""
