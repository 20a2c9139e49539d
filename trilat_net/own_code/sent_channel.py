"""Determines which vectors a user's control law sends to other arms, without running the law.

Each arm sends its motion to the other arms. A law may send further vectors, for example waves
or energies, which its class declares in `sends` (`laws.sent_vectors`). This module reads the
declaration from the source code, and computes where each vector is stored in the messages.

Invariant:
    - A declaration is a literal in the source of the law, so reading it runs no user code.
"""

import ast
import keyword
from pathlib import Path
from typing import Any

import numpy as np

from ..core import MAX_RECORD_SENT, MAX_SENT, LawChannel, SentVector
from ..errors import ScenarioError, count_nouns
from ..laws import SentVectorSpecs, convert_sends
from ..records import Layout


def build_channel(sends: SentVectorSpecs, layout: Layout, peers: int) -> LawChannel:
    """Returns the vectors that a law sends from a site, with their lengths, in message order.

    A law declares the vectors without knowing the arm. Their lengths follow from the numbers of
    joints and coordinates.

    Args:
        sends: Maps the name of each declared vector to its declaration.
        layout: Numbers of the site's joints and coordinates.
        peers: Number of the site's peers.
    """
    counts = {"joints": layout.joints, "coordinates": layout.shared}
    vectors = []
    for name, spec in sends.items():
        length = spec.length
        if not isinstance(length, int):
            length = counts[length]
        vector = SentVector(name, spec.unit, length, spec.per_peer)
        vectors.append(vector)
    common_first = sorted(vectors, key=lambda vector: vector.per_peer)
    return LawChannel(tuple(common_first), peers)


def check_sends(channel: LawChannel, joints: int, path: str) -> None:
    """Raises ScenarioError if the vectors that a law sends have invalid names or are too long.

    The vectors are part of each network message between arms, and a long message would take too
    much time.

    Args:
        channel: All vectors that the law sends to other sites.
        joints: Number of joints of the site's arm.
        path: Path of the law's settings in the scenario file, for error messages.

    Raises:
        ScenarioError: A name is not allowed, or the vectors have more entries than a message or
            a log entry can hold.
    """
    sends_path = f"{path}.sends"
    for vector in channel.vectors:
        problem = _find_name_problem(vector.name)
        if problem:
            raise ScenarioError(problem, path=f"{sends_path}.{vector.name}")

    largest_count = MAX_SENT * joints
    if channel.received_size > largest_count:
        count = count_nouns(channel.received_size, "number")
        problem = (
            f"sends {count} to each peer, but a law may send at most {largest_count}, "
            f"{MAX_SENT} per joint"
        )
        raise ScenarioError(problem, path=sends_path)

    if channel.record_size > MAX_RECORD_SENT:
        count = count_nouns(channel.record_size, "number")
        receivers = count_nouns(channel.peers, "peer")
        problem = (
            f"sends {count} to {receivers} together, but a record holds at most "
            f"{MAX_RECORD_SENT}"
        )
        raise ScenarioError(problem, path=sends_path)


def _find_name_problem(name: str) -> str:
    """Returns the reason why a name is unsuitable for a vector.

    A law reads the vector as an attribute of its input, so the name must be an identifier, and
    must not be an existing attribute of the input.

    Returns:
        The reason. Empty if the name is suitable.
    """
    is_identifier = name.isidentifier() and not keyword.iskeyword(name)
    is_public = not name.startswith("_") and len(name) <= 24
    if not (is_identifier and is_public):
        return (
            "is not a valid name for a vector: the name must start with a letter, contain only "
            "letters, digits and _, have at most 24 characters, and not be a Python keyword"
        )
    is_record_attribute = hasattr(np.record, name)
    if is_record_attribute or hasattr(tuple, name):
        return (
            "is reserved, because every record of numbers has an attribute of that name: "
            "choose another name"
        )
    return ""


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
    """Returns the vectors that a law's class declares in a file, without running the file.

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
