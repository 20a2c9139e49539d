"""Record the messages of a session in a log (`record_process`), and play logs (`play`)."""
