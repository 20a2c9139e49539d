"""Formats that logs are exported to, one a file: a file and its format's name are one."""

import pkgutil


def list_export_formats() -> list[str]:
    """Returns the names of all formats."""
    return [found.name for found in pkgutil.iter_modules(__path__)]
