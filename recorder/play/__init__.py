"""Play a log on the network again: the same bytes at the same times, in a session of its own."""
