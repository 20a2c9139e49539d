"""What a package of somebody else may use to add commands to `trilat`.

A package registers a command by an entry point (docs/develop/packages.md). The function of the
command is declared with `command`. These names stay, as those of `trilat_net` do. All other
modules of this program may change.
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
