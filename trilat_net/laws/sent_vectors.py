"""What a control law sends to its peers, as its class declares it.

Invariant: a declaration is a literal in the class of the law, so that nothing of a user's code
runs to read it; it stands in the resolved scenario, which is enough to read the law's records.
"""

import ast
import keyword
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ..core.chain import MAX_JOINTS
from ..core.law_channel import MAX_RECORD_SENT, MAX_SENT, LawChannel, SentVector
from ..core.site_setup import Layout
from ..errors import ScenarioError, count_nouns
from ..fields import Frozen, reword_problem


class SentVectorSpec(Frozen, frozen=True):
    """A vector that a law sends at every tick, see `core.law_channel`.

    Attributes:
        unit: of its numbers, as in "J"; "" for those without.
        length: how many numbers it has: "joints", "coordinates" (that sites share), or a
            number.
        per_peer: true: another one for each peer; false: the same for all.
    """

    unit: Annotated[str, Meta(max_length=24, pattern=r"^[ -~]*$")] = ""
    length: (
        Literal["joints", "coordinates"] | Annotated[int, Meta(ge=1, le=MAX_SENT * MAX_JOINTS)]
    ) = "joints"
    per_peer: bool = False


SentVectorSpecs = dict[str, SentVectorSpec]


def build_channel(
    sends: Mapping[str, SentVectorSpec], layout: Layout, peers: int
) -> LawChannel:
    """Returns the channel of a law at a site with vectors of such lengths and with so many
    peers.
    """
    counts = {"joints": layout.joints, "coordinates": layout.shared}
    vectors = [
        SentVector(
            name,
            one.unit,
            one.length if isinstance(one.length, int) else counts[one.length],
            one.per_peer,
        )
        for name, one in sends.items()
    ]
    return LawChannel(tuple(sorted(vectors, key=lambda vector: vector.per_peer)), peers)


def check_sends(channel: LawChannel, joints: int, path: str) -> None:
    """Refuses names that no attribute can have, and more numbers than a sample holds; `path`:
    of the law.

    Raises:
        ScenarioError: with the path of the key.
    """
    for name, *_ in channel.vectors:
        if (
            not name.isidentifier()
            or keyword.iskeyword(name)
            or name.startswith("_")
            or len(name) > 24
        ):
            problem = "is no name for a vector: a letter, then letters, digits and _, at most 24 of them"
        elif hasattr(np.record, name) or hasattr(tuple, name):
            problem = "is taken: every record of numbers has an attribute of that name; choose another"
        else:
            continue
        raise ScenarioError(problem, path=f"{path}.sends.{name}")
    if (count := channel.received_size) > (most := MAX_SENT * joints):
        problem = (
            f"sends {count_nouns(count, 'number')} to each peer, and at most {most} "
            f"are taken, {MAX_SENT} per joint"
        )
        raise ScenarioError(problem, path=f"{path}.sends")
    if channel.record_size > MAX_RECORD_SENT:
        count = channel.record_size
        most = MAX_RECORD_SENT
        problem = (
            f"sends {count_nouns(count, 'number')} to "
            f"{count_nouns(channel.peers, 'peer')} together, and a record holds at most {most}"
        )
        raise ScenarioError(problem, path=f"{path}.sends")


def parse_classes(source: bytes, file: Path, path: str) -> dict[str, ast.ClassDef]:
    """Returns the classes that a file defines at its top level, by their names; nothing of it
    runs.

    Raises:
        ScenarioError: it is no Python.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError) as error:
        raise ScenarioError(f"{file} is no Python: {error}", path=path) from None
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


def read_sends(source: bytes, file: Path, code: str, path: str) -> SentVectorSpecs:
    """Returns what the class of a law declares that it sends, as its file writes it, without
    running it.

    Raises:
        ScenarioError: the file is no Python, or the declaration is no literal, or none of
            vectors.
    """
    found: Any = {}
    law = parse_classes(source, file, path).get(code.partition(":")[2])
    for node in (
        line
        for line in (law.body if law else ())
        if isinstance(line, ast.Assign | ast.AnnAssign)
    ):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if node.value is None or "sends" not in {
            one.id for one in targets if isinstance(one, ast.Name)
        }:
            continue
        where = f"{code}: sends in line {node.lineno} of {file.name}"
        try:
            found = ast.literal_eval(node.value)
        except (ValueError, TypeError, RecursionError):
            problem = f"{where} must be written out, as it is read and not run"
            raise ScenarioError(problem, path=path) from None
        if isinstance(node.value, ast.Dict) and len(found) < len(node.value.keys):
            raise ScenarioError(f"{where} has a name twice", path=path)
    return convert_sends(found, code, path)


def convert_sends(sends: Any, code: str, path: str) -> SentVectorSpecs:
    """Returns the declaration of a law's class as types.

    Raises:
        ScenarioError: it is none.
    """
    try:
        return msgspec.convert(sends, SentVectorSpecs)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at ")
        text = f"{code}: sends{place.strip('`$')}: {reword_problem(problem)}, as in"
        example = "{'energy': {'unit': 'J', 'length': 'joints', 'per_peer': True}}"
        raise ScenarioError(f"{text} {example}", path=path) from None
