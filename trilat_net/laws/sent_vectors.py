"""Reads and checks the declaration of the vectors that a control law sends.

Some laws send vectors such as waves or energies in addition to the motion. The class of the law
declares their names and lengths in the class variable `sends`, which the receivers need to
decode the messages.

Invariant:
    - A declaration is a literal in the source of the law, so no user code is run to read it.
    - The declaration is stored with the resolved scenario. No other file is needed to decode
      the vectors sent in a run.
"""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from ..core import MAX_SENT
from ..errors import ScenarioError
from ..fields import Frozen, reword_problem, split_refusal
from ..records import MAX_JOINTS


class _SentVectorSpec(Frozen, frozen=True):
    """Declaration of a vector that a control law sends in every tick.

    The length may depend on the arm, which is not known to the class of the law.

    Attributes:
        unit: Unit of its entries, for example "J", or "" if they are dimensionless.
        length: Number of entries: "joints", "coordinates" (shared by the sites), or a number.
        per_peer: True if each peer gets a different vector, False if all peers get the same
            vector.
    """

    unit: Annotated[str, Meta(max_length=24, pattern=r"^[ -~]*$")] = ""
    length: (
        Literal["joints", "coordinates"] | Annotated[int, Meta(ge=1, le=MAX_SENT * MAX_JOINTS)]
    ) = "joints"
    per_peer: bool = False


SentVectorSpecs = dict[str, _SentVectorSpec]


def convert_sends(sends: Any, code: str, path: str) -> SentVectorSpecs:
    """Checks and converts the declaration of the vectors that a control law sends.

    The class variable `sends` declares the name, unit and length of each vector.

    Args:
        sends: Value of the class variable.
        code: Name of the law, for error messages.
        path: Path of the key in the scenario, for error messages.

    Returns:
        A mapping from vector name to specification.

    Raises:
        ScenarioError: The value is not a valid declaration.
    """
    try:
        return msgspec.convert(sends, SentVectorSpecs)
    except msgspec.ValidationError as error:
        refusal, key = split_refusal(error)
        example = "{'energy': {'unit': 'J', 'length': 'joints', 'per_peer': True}}"
        problem = f"{code}: sends{key}: {reword_problem(refusal)}, as in {example}"
        raise ScenarioError(problem, path=path) from None
