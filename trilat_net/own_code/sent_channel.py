"""Determines which vectors a user's control law sends to other arms, without running the law.

Each arm sends its motion to the other arms. A law may send further vectors, for example waves
or energies, which its class declares in `sends` (`laws.sent_vectors`). This module reads the
declaration from the source code.

Invariant:
    - A declaration is a literal in the source of the law, so reading it runs no user code.
"""

import ast
from pathlib import Path
from typing import Any

from ..errors import ScenarioError
from ..laws import SentVectorSpecs, convert_sends


def parse_classes(source: bytes, file: Path, path: str) -> dict[str, ast.ClassDef]:
    """Returns the top-level classes in a Python file, without running the file.

    The file is only parsed, because the code may not have been permitted to run yet.

    Args:
        source: Content of the file.
        file: Path of the file, for error messages.
        path: Path of the key in the scenario, for error messages.

    Returns:
        Maps the name of each class to its syntax tree.

    Raises:
        ScenarioError: The file is not valid Python.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError) as error:
        raise ScenarioError(f"{file} is not valid Python: {error}", path=path) from None
    return {
        statement.name: statement
        for statement in tree.body
        if isinstance(statement, ast.ClassDef)
    }


def read_sends(source: bytes, file: Path, code: str, path: str) -> SentVectorSpecs:
    """Returns the vectors that a law sends, according to its file, without running the file.

    The scenario needs these vectors before the code has been permitted to run.

    Args:
        source: Content of the file.
        file: Path of the file, for error messages.
        code: Name of the law, as in "mylaws:Line".
        path: Path of the key in the scenario, for error messages.

    Raises:
        ScenarioError: The file is not valid Python, or the declaration is not a literal that
            describes vectors.
    """
    sends: Any = {}
    class_name = code.partition(":")[2]
    class_node = parse_classes(source, file, path).get(class_name)
    statements = class_node.body if class_node else []
    for statement in statements:
        if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
            continue
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        names = {target.id for target in targets if isinstance(target, ast.Name)}
        if "sends" not in names:
            continue

        value = statement.value
        location = f"{code}: sends in line {statement.lineno} of {file.name}"
        try:
            sends = ast.literal_eval(value)
        except (ValueError, TypeError, RecursionError):
            problem = (
                f"{location} must be written out as a literal, because the file is read but "
                "not run"
            )
            raise ScenarioError(problem, path=path) from None
        if isinstance(value, ast.Dict) and len(sends) < len(value.keys):
            raise ScenarioError(f"{location} contains the same name twice", path=path)
    return convert_sends(sends, code, path)
