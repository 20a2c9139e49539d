"""Names that files of users import from here: logs of their control laws name those files by hash."""

from .plug.user_law import LawContext, LawInput

__all__ = ["LawContext", "LawInput"]
