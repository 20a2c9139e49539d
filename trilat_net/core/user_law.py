"""Names that files of users import from here. Logs name those files by their hash."""

from .plug.user_law import LawContext, LawInput

__all__ = ["LawContext", "LawInput"]
