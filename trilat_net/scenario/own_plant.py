"""Reads the scenario table of a plant: a user's own simulation of an arm.

A plant is a class that computes the motion of an arm, and possibly of other bodies, in place of
the built-in simulation. The scenario names the class:

    plant = "my_plant:Scene"            # or a table: { class = "my_plant:Scene", mass_kg = 2 }

See `plant_player` for running the plants of a scenario.
"""

import re
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from msgspec import Meta, field

from ..errors import ScenarioError
from ..fields import Frozen
from ..own_code import CLASS_PATTERN, read_code
from .key_checks import is_number

_BODY_NAME = re.compile(r"[a-z][a-z0-9_]{0,29}")
_MAX_BODIES = 32
"""Maximum number of bodies that a plant moves in addition to its arm."""
_MAX_SIZE_M = 100.0
"""Largest extent of a body, in m."""


class OwnPlant(Frozen, frozen=True, rename={"code": "class"}, omit_defaults=True):
    """Scenario table of a plant: a user's Python class that computes the motion of an arm.

    Attributes:
        code: Class of the plant, for example "my_plant:Scene".
        source_sha256: SHA-256 hash of the file that contains the class.
        bodies: Mapping from name to size of the bodies that the plant moves in addition to the
            arm. The size is that of a box around the body along its own axes x, y and z, in m.
            Their poses are recorded and drawn.
        settings: Mapping from name to value of the constructor arguments of the class.
    """

    method: ClassVar[str] = "step"

    code: Annotated[str, Meta(pattern=CLASS_PATTERN, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    bodies: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)

    @staticmethod
    def complete_table(written: Any, path: str) -> Any:
        """Completes the `plant` setting of a site.

        The result contains the SHA-256 hash of the file of the class, the constructor arguments
        of the class, and the sizes of the bodies.

        Args:
            written: Value of the key `plant` as written by its author: a class name such as
                "my_plant:Scene", or a table.
            path: Path of the key, for error messages.

        Returns:
            The completed table. A string that is not a class name, such as "external", or a
            value of a wrong type is returned unchanged.

        Raises:
            ScenarioError: The class is missing, its file cannot be read, or the size of a body
                is not valid.
        """
        table = written
        if isinstance(written, str) and ":" in written:
            table = {"class": written}
        if not isinstance(table, Mapping):
            return written
        code = table.get("class")
        if not isinstance(code, str):
            raise ScenarioError("must be a class, as in 'my_plant:Scene'", path=f"{path}.class")
        bodies = {}
        if "bodies" in table:
            bodies["bodies"] = _check_bodies(table["bodies"], f"{path}.bodies")
        # A table with a hash has been resolved before.
        if "source_sha256" in table:
            return {**table, **bodies}

        settings = {
            key: value for key, value in table.items() if key not in ("class", "bodies")
        }
        return {
            "class": code,
            "source_sha256": read_code(code, path).sha256,
            "settings": settings,
            **bodies,
        }


def _check_bodies(written: Any, path: str) -> Any:
    """Validates the names and sizes of the bodies that a plant moves in addition to the arm.

    Returns the table unchanged if it is valid.

    Raises:
        ScenarioError: There are too many bodies, or a name or extent is not valid.
    """
    if not isinstance(written, Mapping) or len(written) > _MAX_BODIES:
        example = "{ box = [0.2, 0.2, 0.1] }"
        raise ScenarioError(
            f"must be the sizes of at most {_MAX_BODIES} bodies, as in {example}", path=path
        )
    for name, size in written.items():
        if not _BODY_NAME.fullmatch(name):
            raise ScenarioError(
                f"the name of a body may contain only a to z, 0 to 9 and _, not {name!r}",
                path=path,
            )
        if not _is_box_size(size):
            raise ScenarioError(
                f"must be three sizes in m, each above 0 and at most {_MAX_SIZE_M:g}, but is "
                f"{size!r}",
                path=f"{path}.{name}",
            )
    return written


def _is_box_size(size: Any) -> bool:
    """Returns True for a list of three lengths in m that are valid for a body."""
    if not isinstance(size, list | tuple) or len(size) != 3:
        return False
    return all(is_number(length) and 0.0 < length <= _MAX_SIZE_M for length in size)
