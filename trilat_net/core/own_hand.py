"""Names that files of users import from here: logs of their hands name those files by hash."""

from .life.own_hand import HandContext, HandView

__all__ = ["HandContext", "HandView"]
