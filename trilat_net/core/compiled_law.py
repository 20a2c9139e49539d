"""Names that files of users import from here: logs of their control laws name those files by hash."""

from .plug.compiled_law import compiled

__all__ = ["compiled"]
