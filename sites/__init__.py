"""Runs live sessions: a process per arm joins a session, runs its control loop, and leaves."""
