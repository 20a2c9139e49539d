"""Figures of a log for a paper: which there are, one by one, and as files."""
