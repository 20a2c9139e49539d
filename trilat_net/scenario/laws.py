"""The control laws that a scenario can choose, by name: each file of the room `laws` that has
one.

Invariant: a law is found by its file alone, whose class bears the same name; nothing else lists
laws.
"""

import pkgutil
from collections.abc import Iterator
from importlib import import_module
from typing import TYPE_CHECKING, Any, Union

from ..laws.interface import ControlLaw, LawSettings, format_class_name
from .imported_code import ImportedLaw

_ROOM = "trilat_net.laws"


def _find_laws() -> Iterator[type[ControlLaw]]:
    for found in pkgutil.iter_modules(import_module(_ROOM).__path__):
        kind = getattr(
            import_module(f"{_ROOM}.{found.name}"), format_class_name(found.name), None
        )
        if isinstance(kind, type) and issubclass(kind, ControlLaw):
            yield kind


BUILT_IN: dict[str, type[ControlLaw]] = {
    str(law.Settings.__struct_config__.tag): law for law in _find_laws()
}
"""The built-in laws by name."""
LAWS: dict[str, type[LawSettings]] = {
    **{name: law.Settings for name, law in BUILT_IN.items()},
    str(ImportedLaw.__struct_config__.tag): ImportedLaw,
}
"""By name the gains that a scenario may have, those of a user's law too."""
if TYPE_CHECKING:
    ChosenLaw = LawSettings
else:
    ChosenLaw = Union[tuple(LAWS.values())]  # noqa: UP007 - made of what was found
    """The type of a site's control."""


def identify_law(law: Any) -> str:
    """Returns what a scenario calls a law; an imported one as in "package.module:Law"."""
    return law.code if isinstance(law, ImportedLaw) else str(law.tag)
