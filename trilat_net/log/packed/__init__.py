"""Decodes many messages of a log at once, in compiled code.

At 1 kHz, one minute of a run yields 60 000 messages per arm, and a Python object for each of
them would make reading slow. This package therefore keeps the messages of a channel one after
another in one block of bytes, and reads numbers from the block with Numba. The compiled code
accepts only the exact layout that this program writes. Everything else is left to the decoders
of `record_columns` and `net.wire`, so that results and error messages do not depend on this
package.
"""
