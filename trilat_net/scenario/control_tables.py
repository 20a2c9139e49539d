"""Completes the table `control` of a scenario: the control law of an arm and its gains.

A scenario is a TOML file that describes an experiment. Its author chooses a built-in law by its
name, or names a class of Python as "module:Class", for example by

    control = { law = "my_law:Spring", stiffness = 5 }

Invariant:
    - The file of a class is read, but not executed.
"""

import os
import re
from pathlib import Path

import msgspec

from ..errors import ScenarioError
from ..fields import TomlTable
from ..own_code import CLASS_PATTERN, parse_classes, read_code, read_sends
from .key_checks import VectorCounts, check_choice, expand_vectors
from .laws import LAWS
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
            same law; other laws have other gains.
        path: Path of the table, for error messages.
        counts: Lengths to which a single number per vector is expanded.

    Raises:
        ScenarioError: There is no such law, or it has no such gain.
    """
    common_law = common.get("law", _DEFAULT_LAW)
    law = str(written.get("law", common_law))
    if ":" in law:
        return _complete_own_law(law, written, common, path)
    if law not in LAWS:
        raise _refuse_law(law, f"{path}.law")
    check_control(written, law, path)
    inherited = common if common_law == law else {}
    return expand_vectors({**inherited, **written, "law": law}, LAWS[law], counts)


def _complete_own_law(code: str, written: TomlTable, common: TomlTable, path: str) -> TomlTable:
    """Returns the complete table of a control law that a user wrote as a Python class.

    The table contains the name of the class, the hash of its file, and the vectors that the law
    sends to other arms.

    Args:
        code: Module and class, for example "package.module:Law".
        written: Table `control` of the site. Apart from the key `law`, it contains the
            arguments of the class.
        common: Table `control` for all sites. Its arguments apply if it names the same class.
        path: Path of the table, for error messages.

    Raises:
        ScenarioError: The name is not valid, the file cannot be read, or the table contains a
            key that it must not have.
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
