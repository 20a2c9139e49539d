"""Execution from a log: the records of a session fed back into `Site.step`, and what came of it."""
