"""Looks up control laws by the name that a scenario gives.

A control law computes the torques of an arm from the state of the arm and the delayed states of
its peers.

Invariant:
    - A law is found through its file in the package `trilat_net.laws`, which contains a class
      with the same name as the file. There is no other list of laws.
"""

from typing import TYPE_CHECKING, Union

from ..laws import ControlLaw, LawSettings
from ..own_code import ImportedLaw

BUILT_IN: dict[str, type[ControlLaw]] = {
    str(law.Settings.__struct_config__.tag): law for law in ControlLaw.find_built_in()
}
"""Mapping from name to class of the built-in laws."""
LAWS: dict[str, type[LawSettings]] = {
    **{name: law.Settings for name, law in BUILT_IN.items()},
    str(ImportedLaw.__struct_config__.tag): ImportedLaw,
}
"""Mapping from law name to the type of its gains. All users' laws share one type and name."""
if TYPE_CHECKING:
    ChosenLaw = LawSettings
else:
    # Built at run time from the laws that were found.
    ChosenLaw = Union[tuple(LAWS.values())]  # noqa: UP007
    """Type of the key `control` of a site."""
