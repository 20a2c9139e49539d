"""Decodes many messages of a log at once, in compiled code.

At 1 kHz, one minute of a run yields 60 000 messages per arm, and reading would be slow if each
became a Python object. This package therefore stores the messages of a channel one after
another in a single block of bytes, and reads numbers from that block with Numba. The compiled
code accepts only the exact layout that this program writes. Everything else is left to the
decoders of `record_columns` and `net.wire`, so results and error messages do not depend on this
package.
"""
