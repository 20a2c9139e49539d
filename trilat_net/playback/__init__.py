"""A log once more on the network: the same bytes with the same timing, under another session."""
