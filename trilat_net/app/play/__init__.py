"""Plays a log: publishes its messages on the network again, at their original times.

Recorders and viewers can thus be tested, and a session can be shown, without the arms.
`play_process` is the process that plays, `session_reader` reads the log, and `player` keeps the
times.
"""
