"""Defines the file formats to which logs can be exported, one module per format.

The name of a module is the name of its format, as in `trilat log export run.mcap --to csv`. A
module has a constant `FORMAT` of the type `export.ExportFormat`. To add a format, add a module
to this folder.
"""

import pkgutil


def list_export_formats() -> list[str]:
    """Lists the names of all formats in which a log can be exported.

    Each format is a module in this folder and has its name. The modules are not imported, so
    that the help of `trilat export` can list the formats quickly.
    """
    return [module.name for module in pkgutil.iter_modules(__path__)]
