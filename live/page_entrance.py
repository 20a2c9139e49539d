"""Which connections the page's server keeps: strangers without a role, and pages by their role.

Invariant:
    - Connections whose role is not known yet (silent or slow ones, downloads) are bounded in
      number. The oldest one is closed for a new one, so that nobody who holds many of them
      keeps others out.
    - The number of pages is limited for each role. Watchers do not use up the places of other
      roles.
    - A page of an experimenter or a user is always accepted. If there are too many, the oldest
      page of that role is closed; among experimenters, those that do not take part first.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Protocol, TypeVar

from websockets.asyncio.server import ServerConnection

from .page_orders import Role

MAX_STRANGERS = 64
"""Largest number of open connections without a role."""
MAX_PAGES = {"experimenter": 4, "user": 2, "watcher": 12}
"""Largest number of open pages of a role; for users, at each site."""


class Strangers:
    """The connections whose role is not known yet, the oldest first.

    Args:
        refused: counts refusals by reason.
    """

    def __init__(self, refused: Counter[str]) -> None:
        self._connections: dict[ServerConnection, None] = {}
        self._refused = refused

    def add(self, connection: ServerConnection) -> None:
        """Adds a new connection; closes the oldest one if there are too many."""
        if len(self._connections) >= MAX_STRANGERS:
            oldest = next(iter(self._connections))
            self.remove(oldest)
            self._refused["too many connections"] += 1
            oldest.transport.abort()
        self._connections[connection] = None

    def remove(self, connection: ServerConnection) -> None:
        """Removes a connection that was closed or has a role now."""
        self._connections.pop(connection, None)


class SeatedPage(Protocol):
    """A page that counts towards the limit of its role."""

    role: Role
    number: int
    takes_part: bool


P = TypeVar("P", bound=SeatedPage)


def is_full(pages: Iterable[SeatedPage], role: Role) -> bool:
    """Returns whether there are as many pages of a role as allowed."""
    return len(_list_pages_like(pages, role)) >= MAX_PAGES[role.kind]


def choose_page_to_close(pages: Iterable[P], role: Role) -> P | None:
    """Returns the page to close for a new page of a role; None if there is room."""
    candidates = _list_pages_like(pages, role)
    if len(candidates) < MAX_PAGES[role.kind]:
        return None
    return min(
        candidates,
        key=lambda page: (role.kind == "experimenter" and page.takes_part, page.number),
    )


def _list_pages_like(pages: Iterable[P], role: Role) -> list[P]:
    """Returns the pages of a role; for users, those of the same site."""

    def group_of(role: Role) -> tuple[str, str]:
        return role.kind, role.site if role.kind == "user" else ""

    return [page for page in pages if group_of(page.role) == group_of(role)]
