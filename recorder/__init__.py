"""Records every channel of a session into one MCAP file (`record_process`).

And plays a log again (`play`).
"""
