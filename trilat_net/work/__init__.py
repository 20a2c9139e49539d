"""Work in many runs: processes that share it, folders that keep it, and intervals."""
