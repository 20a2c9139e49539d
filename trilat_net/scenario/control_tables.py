"""Completes the table `control` of a scenario: the control law of an arm and its gains.

A scenario is a TOML file that describes an experiment. Its author chooses a built-in law by its
name, or names a Python class as "module:Class".
"""

import os
from pathlib import Path

from ..errors import ScenarioError
from ..fields import TomlTable
from ..own_code import parse_classes
from .key_checks import VectorCounts, check_choice, expand_vectors
from .laws import LAWS
from .own_law import complete_own_law
from .written_tables import check_control

_DEFAULT_LAW = "adaptive"


def complete_control(
    written: TomlTable, common: TomlTable, path: str, counts: VectorCounts
) -> TomlTable:
    """Returns the table of a control law in which every gain has a value.

    Gains that the author of the scenario left out get their defaults, and a single number
    becomes a vector with one number per joint.

    Args:
        written: Table `control` of a site as its author wrote it.
        common: Table `control` for all sites. Its gains replace missing gains if it names the
            same law, because other laws have other gains.
        path: Path of the table, for error messages.
        counts: Lengths to which a single number per vector is expanded.

    Raises:
        ScenarioError: There is no such law, or it has no such gain.
    """
    common_law = common.get("law", _DEFAULT_LAW)
    law = str(written.get("law", common_law))
    if ":" in law:
        return complete_own_law(law, written, common, path)
    if law not in LAWS:
        raise _refuse_law(law, f"{path}.law")
    check_control(written, law, path)
    inherited = common if common_law == law else {}
    return expand_vectors({**inherited, **written, "law": law}, LAWS[law], counts)


def _refuse_law(law: str, path: str) -> ScenarioError:
    """Returns the error for the name of a control law that does not exist.

    If a Python file of that name exists, the message contains the right name of its class.

    Args:
        law: The name.
        path: Path of the key, for error messages.
    """
    file = Path(law if law.endswith(".py") else f"{law}.py")
    if os.path.isfile(file):  # noqa: PTH113 - Path.is_file raises for a very long name
        classes = parse_classes(file.read_bytes(), file, path)
        names = [f"{file.stem}:{name}" for name in classes]
        remedy = f"write {' or '.join(names)}" if names else "it defines no class"
        return ScenarioError(f"is {law!r}, but a law in a file is a class: {remedy}", path=path)
    # "own" is the type of users' laws in canonical texts.
    built_in = [name for name in LAWS if name != "own"]
    check_choice(law, [*built_in, "module:Class"], path)
    return ScenarioError(f"is {law!r}, but must name a class as module:Class", path=path)
