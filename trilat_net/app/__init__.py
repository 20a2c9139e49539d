"""What people start: the command line, the Python interface, demo, doctor and player."""
