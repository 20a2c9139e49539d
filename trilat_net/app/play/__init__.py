"""Plays a log: publishes its messages on the network again, with their original timing.

This allows recorders and viewers to be tested, and a session to be shown, without the arms. The
playback process is in `play_process`, `session_reader` reads the log, and `player` controls the
timing.
"""
