"""Names that files of users import from here. Logs name those files by their hash."""

from .life.own_hand import HandContext, HandView

__all__ = ["HandContext", "HandView"]
