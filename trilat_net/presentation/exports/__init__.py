"""Defines the formats to which logs are exported, one module per format.

A log is the MCAP file with the results of a run. The name of a module is the name of its
format. A module has a constant `FORMAT` of the type `export.ExportFormat`. Adding a module to
this folder adds a format to `trilat export`.
"""

import pkgutil


def list_export_formats() -> list[str]:
    """Lists the names of all formats in which a log can be exported.

    Each format is a module in this folder and has its name. The modules are not imported, so
    that the help of `trilat export` can list the formats quickly.
    """
    return [module.name for module in pkgutil.iter_modules(__path__)]
