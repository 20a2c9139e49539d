"""Names that files of users import from here. Logs name those files by their hash."""

from .plug.compiled_law import compiled

__all__ = ["compiled"]
