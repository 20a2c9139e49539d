"""Drivers that run `Site.step` again: in virtual time, from a log, and from a log with changed
settings.
"""
