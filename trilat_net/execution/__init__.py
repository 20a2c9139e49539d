"""Executes sites in virtual time: anew, from a log, or from a log with changed settings."""
