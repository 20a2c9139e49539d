"""Who gets a connection to the page's server: strangers without a role, and pages by their
role.

Invariant:
- Connections whose role is not known yet (silent ones, slow ones, downloads) are bounded in
  number. The oldest one gives way to a new one, so that nobody who holds many of them keeps
  others out.
- Pages have places by role. Watchers take places of their own and no others. A page of an
  experimenter or a user always gets in: if all places of its role are taken, the oldest page of
  that role gives way. Among experimenters those that do not take part go first.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Protocol, TypeVar

from websockets.asyncio.server import ServerConnection

from .page_orders import Role

MOST_STRANGERS = 64
"""Open connections without a role."""
MOST_PAGES = {"experimenter": 4, "user": 2, "watcher": 12}
"""Open pages of a role; of users at each site."""


class Strangers:
    """The connections whose role is not known yet, the oldest first."""

    def __init__(self, refused: Counter[str]) -> None:
        self._open: dict[ServerConnection, None] = {}
        self._refused = refused

    def add(self, connection: ServerConnection) -> None:
        """Takes in a new connection; ends the oldest one if there are too many."""
        if len(self._open) >= MOST_STRANGERS:
            oldest = next(iter(self._open))
            self.remove(oldest)
            self._refused["too many connections"] += 1
            oldest.transport.abort()
        self._open[connection] = None

    def remove(self, connection: ServerConnection) -> None:
        """Forgets a connection, which was closed or got a role."""
        self._open.pop(connection, None)


class Placed(Protocol):
    """A page that has a place."""

    role: Role
    number: int
    takes_part: bool


P = TypeVar("P", bound=Placed)


def is_full(pages: Iterable[Placed], role: Role) -> bool:
    """True if a role has no free place."""
    return len(_list_alike(pages, role)) >= MOST_PAGES[role.kind]


def choose_to_leave(pages: Iterable[P], role: Role) -> P | None:
    """Returns the page that gives its place to a new page of a role; None if there is a free
    place.
    """
    alike = _list_alike(pages, role)
    if len(alike) < MOST_PAGES[role.kind]:
        return None
    return min(
        alike, key=lambda page: (role.kind == "experimenter" and page.takes_part, page.number)
    )


def _list_alike(pages: Iterable[P], role: Role) -> list[P]:
    def place_of(one: Role) -> tuple[str, str]:
        return one.kind, one.site if one.kind == "user" else ""

    return [page for page in pages if place_of(page.role) == place_of(role)]
