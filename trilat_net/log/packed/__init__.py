"""Reads encoded messages in compiled code, without a Python object for each of them.

The messages of a channel are stored one after another in one block of bytes. The compiled code
accepts only the exact layout that this program writes. Everything else is left to the decoders
of `record_columns` and `net.wire`, so that their results and error messages do not depend on
this package.
"""
