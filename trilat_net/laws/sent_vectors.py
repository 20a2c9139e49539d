"""Reads and checks which vectors a control law sends to its peers.

Each site, a process that runs one arm, sends the motion of its arm to the other sites. Its law
may send more, for example waves or energies. The class of the law declares these vectors, with
their names and lengths, in the class variable `sends`.

Invariant:
    - A declaration is a literal in the source of the law, so reading it runs no user code.
    - The declaration is stored with the resolved scenario, the complete description of an
      experiment. No other file is needed to read what the law sent in a run.
"""

import ast
import keyword
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ..core.arms.chain import MAX_JOINTS
from ..core.plug.law_channel import MAX_RECORD_SENT, MAX_SENT, LawChannel, SentVector
from ..core.step.site_setup import Layout
from ..errors import ScenarioError, count_nouns
from ..fields import Frozen, reword_problem, split_refusal


class _SentVectorSpec(Frozen, frozen=True):
    """Declaration of a vector that a law sends at every tick, see `core.law_channel`.

    Attributes:
        unit: Unit of its numbers, as in "J"; "" for dimensionless numbers.
        length: Count of its numbers: "joints", "coordinates" (that sites share), or a number.
        per_peer: True: each peer gets its own vector; false: all peers get the same vector.
    """

    unit: Annotated[str, Meta(max_length=24, pattern=r"^[ -~]*$")] = ""
    length: (
        Literal["joints", "coordinates"] | Annotated[int, Meta(ge=1, le=MAX_SENT * MAX_JOINTS)]
    ) = "joints"
    per_peer: bool = False


SentVectorSpecs = dict[str, _SentVectorSpec]


def build_channel(
    sends: Mapping[str, _SentVectorSpec], layout: Layout, peers: int
) -> LawChannel:
    """Returns the vectors that a law sends from a site, with their lengths, in their order.

    A law declares the vectors without knowing the arm. Their lengths follow from the counts of
    joints and coordinates.

    Args:
        sends: Declared vectors by name.
        layout: Counts of the site's joints and coordinates.
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
    """Checks the names and the total length of the vectors that a control law sends.

    Args:
        channel: All vectors that the law sends to other sites.
        joints: Number of joints of the site's arm.
        path: Path of the law's settings in the scenario file, for error messages.

    Raises:
        ScenarioError: A name is not allowed, or the vectors have more numbers than a message or
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
    must not be an attribute that the input has already.

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
    """Returns the classes at the top level of a file, by name, without running the file.

    Args:
        source: Content of the file.
        file: The file, for errors.
        path: Path of the key, for errors.

    Raises:
        ScenarioError: The file is not valid Python.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError) as error:
        raise ScenarioError(f"{file} is not valid Python: {error}", path=path) from None
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


def read_sends(source: bytes, file: Path, code: str, path: str) -> SentVectorSpecs:
    """Returns the vectors that a law's class declares in a file, without running the file.

    Args:
        source: Content of the file.
        file: The file, for errors.
        code: Name of the law, as in "mylaws:Line".
        path: Path of the key, for errors.

    Raises:
        ScenarioError: The file is not valid Python, or the declaration is not a literal that
            describes vectors.
    """
    sends: Any = {}
    class_name = code.partition(":")[2]
    law = parse_classes(source, file, path).get(class_name)
    statements = law.body if law else []
    for node in statements:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        names = {target.id for target in targets if isinstance(target, ast.Name)}
        if "sends" not in names:
            continue

        value = node.value
        location = f"{code}: sends in line {node.lineno} of {file.name}"
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


def convert_sends(sends: Any, code: str, path: str) -> SentVectorSpecs:
    """Converts the class variable `sends` of a control law to checked specifications.

    The variable `sends` declares the vectors that the law sends to the other sites, each with
    its name, unit and length.

    Args:
        sends: Value of the class variable.
        code: Name of the law, for error messages.
        path: Path of the key in the scenario, for error messages.

    Returns:
        A specification for each vector, by its name.

    Raises:
        ScenarioError: The value does not describe vectors.
    """
    try:
        return msgspec.convert(sends, SentVectorSpecs)
    except msgspec.ValidationError as error:
        refusal, key = split_refusal(error)
        example = "{'energy': {'unit': 'J', 'length': 'joints', 'per_peer': True}}"
        problem = f"{code}: sends{key}: {reword_problem(refusal)}, as in {example}"
        raise ScenarioError(problem, path=path) from None
