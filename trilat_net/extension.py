"""Public interface for packages that add commands to `trilat`.

A package declares the function of its command with `command`, and registers the command as an
entry point (docs/develop/packages.md). The names in this module and in `trilat_net` are stable
across versions. All other modules of this program may change.
"""

from .app.cli.options import (
    JsonOption,
    LogArgument,
    ScenarioArgument,
    SetOption,
    command,
    flag,
    value,
)
from .errors import UsageError
from .presentation import TextTable, print_json, print_line, print_table

__all__ = [
    "JsonOption",
    "LogArgument",
    "ScenarioArgument",
    "SetOption",
    "TextTable",
    "UsageError",
    "command",
    "flag",
    "print_json",
    "print_line",
    "print_table",
    "value",
]
