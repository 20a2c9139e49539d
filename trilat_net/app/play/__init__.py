"""Play a log on the network again, in a new session: the same bytes at the same times."""
