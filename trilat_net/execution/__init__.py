"""Run `Site.step` in virtual time, again from a log, or from a log with changed settings."""
