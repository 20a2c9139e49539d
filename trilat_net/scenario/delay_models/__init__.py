"""The delay models that a link can have.

Invariant: each is found by its file in this folder; nothing else lists them.
"""

import pkgutil
from collections.abc import Iterator
from importlib import import_module
from typing import TYPE_CHECKING, Union

from .interface import LinkBase


def _find_models() -> Iterator[type[LinkBase]]:
    for found in pkgutil.iter_modules(__path__):
        module = import_module(f"{__name__}.{found.name}")
        here = (one for one in vars(module).values() if getattr(one, "__module__", "") == module.__name__)
        yield from (
            one for one in here if isinstance(one, type) and issubclass(one, LinkBase) and one.is_kind()
        )


DELAY_MODELS: dict[str, type[LinkBase]] = {str(one.__struct_config__.tag): one for one in _find_models()}
"""The models by name."""
if TYPE_CHECKING:
    Link = LinkBase
else:
    Link = Union[tuple(DELAY_MODELS.values())]  # noqa: UP007 - made of what was found
