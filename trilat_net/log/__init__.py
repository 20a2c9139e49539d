"""The MCAP log: write, read, check and recover it. The only importer of `mcap`."""
