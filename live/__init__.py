"""A running session for people: a page that shows it and takes part, and `trilat live`."""
