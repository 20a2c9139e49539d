"""Reads the scenario table of a control law that is a user's Python class.

The law of an arm is selected in the table `control`, for example by

    control = { law = "my_law:Spring", stiffness = 5 }

Invariant:
    - The file of the class is read but not executed.
"""

import re

import msgspec

from ..errors import ScenarioError
from ..fields import TomlTable
from ..own_code import CLASS_PATTERN, read_code, read_sends


def complete_own_law(code: str, written: TomlTable, common: TomlTable, path: str) -> TomlTable:
    """Returns the complete table of a control law that is a user's Python class.

    The table contains the name of the class, the hash of its file, and the vectors that the law
    sends to peers.

    Args:
        code: Module and class, for example "package.module:Law".
        written: Table `control` of the site: the key `law` and the arguments of the class.
        common: Table `control` for all sites. The arguments in this table apply if the table
            names the same class.
        path: Path of the table, for error messages.

    Raises:
        ScenarioError: The name is not valid, the file cannot be read, or the table contains a
            key that is not allowed.
    """
    if not re.fullmatch(CLASS_PATTERN, code):
        problem = f"must have the form package.module:Law, but is {code!r}"
        raise ScenarioError(problem, path=f"{path}.law")
    inherited = common if common.get("law") == code else {}
    settings = {**inherited, **written}
    settings.pop("law", None)
    if "settings" in settings:
        raise ScenarioError(
            "the settings of a user's law must be written next to the key law, as in "
            "control.gain = 5",
            path=f"{path}.settings",
        )
    if "sends" in settings:
        raise ScenarioError(
            "is declared by the class of the law, not here", path=f"{path}.sends"
        )
    source = read_code(code, f"{path}.law")
    sends = msgspec.to_builtins(read_sends(source.content, source.file, code, f"{path}.law"))
    return {
        "law": "own",
        "code": code,
        "source_sha256": source.sha256,
        "settings": settings,
        "sends": sends,
    }
