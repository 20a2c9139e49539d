"""Limits the number of connections that the page server keeps open.

A new connection is called a stranger until the server knows the role of its user: experimenter,
user of one arm, or watcher. From then on, it is called a page. Limiting the number of strangers
and pages prevents anybody from blocking others by opening many connections.

Invariant:
    - Silent or slow connections and downloads count as strangers. If there are too many
      strangers, the oldest is closed to admit a new connection.
    - The number of pages is limited separately for each role, so many watchers cannot displace
      other roles.
    - A new page of an experimenter or a user is always accepted. If there are too many, the
      oldest page with the same role is closed. A page on which an experimenter controls the
      session is closed only if all experimenters' pages control it.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Protocol, TypeVar

from websockets.asyncio.server import ServerConnection

from .page_orders import Role

MAX_STRANGERS = 64
"""Maximum number of open connections with no role."""
MAX_PAGES = {"experimenter": 4, "user": 2, "watcher": 12}
"""Maximum number of open pages per role (for users, per site)."""


class Strangers:
    """Open connections for which the role of the user is not known yet.

    Their number is limited. If there are too many, the oldest is closed, so nobody can block
    others with many silent connections.

    Args:
        refused: Mapping from reason to number of refusals. Connections that are closed because
            there are too many are counted as well.
    """

    def __init__(self, refused: Counter[str]) -> None:
        # The keys of a dictionary keep their order: the oldest connection is first.
        self._connections: dict[ServerConnection, None] = {}
        self._refused = refused

    def add(self, connection: ServerConnection) -> None:
        """Adds a new connection, closing and counting the oldest one if there are too many.

        The user of the oldest connection has had the most time to open a page. Closing this
        connection prevents a flood of connections from blocking new ones.

        Args:
            connection: The new connection, for which the role of the user is not known yet.
        """
        if len(self._connections) >= MAX_STRANGERS:
            oldest = next(iter(self._connections))
            self.remove(oldest)
            self._refused["too many connections"] += 1
            oldest.transport.abort()
        self._connections[connection] = None

    def remove(self, connection: ServerConnection) -> None:
        """Removes a connection that was closed, or through which a page was opened.

        Does nothing if the connection was removed before.
        """
        self._connections.pop(connection, None)


class _SeatedPage(Protocol):
    """Interface of an open web page, as needed to limit the number of pages.

    Implemented by `page_server._Page`.

    Attributes:
        role: Role of the person at the page: experimenter, user of one arm, or watcher.
        number: Number of the page, which is higher for pages opened later.
        takes_part: True if the person may move arms and change settings of the session.
    """

    role: Role
    number: int
    takes_part: bool


Page = TypeVar("Page", bound=_SeatedPage)


def choose_page_to_close(pages: Iterable[Page], role: Role) -> Page | None:
    """Returns the open page that must be closed to admit a new page.

    The number of pages is limited for each role: experimenter, user of an arm, or watcher. The
    oldest page of the role is closed.

    Args:
        pages: The open pages of all roles.
        role: Role of the new page.

    Returns:
        The page to close, or `None` if there is room for the new page.
    """
    role_pages = _list_pages_of_role(pages, role)
    if len(role_pages) < MAX_PAGES[role.kind]:
        return None

    oldest_first = sorted(role_pages, key=lambda page: page.number)
    if role.kind == "experimenter":
        # A page that takes part may hold an arm. It is closed only if all pages take part.
        for page in oldest_first:
            if not page.takes_part:
                return page

    return oldest_first[0]


def _list_pages_of_role(pages: Iterable[Page], role: Role) -> list[Page]:
    """Lists the open pages that a new page of a role may have to replace.

    The number of open pages per role is limited.

    Args:
        pages: The open pages.
        role: Role of the new page. For a user, only pages of users of the same site compete.
    """
    role_pages: list[Page] = []
    for page in pages:
        has_same_kind = page.role.kind == role.kind
        is_of_other_user = role.kind == "user" and page.role.site != role.site
        if has_same_kind and not is_of_other_user:
            role_pages.append(page)
    return role_pages
