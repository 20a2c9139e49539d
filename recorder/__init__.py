"""The recording process: every channel of a session into one MCAP file."""
