"""Defines the file formats to which logs can be exported, one module per format.

The name of the module is the name of the format, as in `trilat log export run.mcap --to csv`.
To add a format, add a module with a constant `FORMAT` of type `export.ExportFormat` to this
folder.
"""

import pkgutil


def list_export_formats() -> list[str]:
    """Lists the names of all formats to which a log can be exported.

    Format names are the names of the modules in this folder. The modules are not imported,
    which keeps the help of `trilat export` fast.
    """
    return [module.name for module in pkgutil.iter_modules(__path__)]
