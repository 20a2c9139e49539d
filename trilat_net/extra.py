"""Packages that not everybody needs.

Law: they are imported where they are used, and one that is missing is answered with what installs it.
"""

from importlib import import_module
from typing import Any

from .errors import UsageError


def extra(module: str, name: str, purpose: str) -> Any:
    """Returns a module that an extra of this package brings.

    Args:
        module: which one, as in "scipy.io".
        name: the extra.
        purpose: what needs it, in the plural.

    Raises:
        UsageError: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise UsageError(f"{purpose} need {package}: pip install 'trilat-net[{name}]'") from None
