"""A session while it runs, for people: a page that shows it and takes part, and `trilat live`."""
