"""The live driver: one operating-system process per manipulator joins a session, runs its loop
and leaves.
"""
