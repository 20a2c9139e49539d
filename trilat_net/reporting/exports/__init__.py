"""The formats that logs are exported to, one module per format.

The name of a module is the name of its format. A module has a constant `FORMAT`, an
`ExportFormat`. A further module in this folder is a further format.
"""

import pkgutil


def list_export_formats() -> list[str]:
    """Returns the names of all formats."""
    return [module.name for module in pkgutil.iter_modules(__path__)]
