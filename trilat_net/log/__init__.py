"""The MCAP layout: what a log holds, how it is written, how it is read. The only importer of `mcap`."""
