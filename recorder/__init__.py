"""Records every channel of a session into one MCAP file (`record_process`), and plays logs
(`play`).
"""
