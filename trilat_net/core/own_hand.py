"""Keeps the path `trilat_net.core.own_hand`, from which users' programs import their types.

The code is in `core.life.own_hand`. Programs that users wrote to move an arm import from here.
A log identifies such a file by its hash, so the file cannot be edited if the log is to be
executed again. Therefore the path must stay.
"""

from .life.own_hand import HandContext, HandView

__all__ = ["HandContext", "HandView"]
