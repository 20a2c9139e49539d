"""Run live sessions: one process per arm joins a session, runs its control loop, and leaves."""
