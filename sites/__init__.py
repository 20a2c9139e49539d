"""The live driver: a process per site joins a session, runs the site's loop, and leaves."""
