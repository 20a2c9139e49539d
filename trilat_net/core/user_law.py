"""Keeps the path `trilat_net.core.user_law`, from which users' control laws import their types.

The code is in `core.plug.user_law`. Control laws that users wrote import from here. A log
identifies such a file by its hash, so the file cannot be edited if the log is to be executed
again. Therefore the path must stay.
"""

from .plug.user_law import LawContext, LawInput

__all__ = ["LawContext", "LawInput"]
