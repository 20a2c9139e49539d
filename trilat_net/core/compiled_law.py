"""Keeps the path `trilat_net.core.compiled_law`, from which users import `compiled`.

The code is in `core.plug.compiled_law`. Files of users contain `from
trilat_net.core.compiled_law import compiled`. A log identifies such a file by its hash, so the
file cannot be edited if the log is to be executed again. Therefore the path must stay.
"""

from .plug.compiled_law import compiled

__all__ = ["compiled"]
