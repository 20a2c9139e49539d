"""Who looks at a page: an experimenter, a user of one site or a watcher, and the links that make them so.

Invariant: a token gives a role and, to a user, a site; the rest of a link may lower the role and never raises
it. Without tokens, on loopback, whoever comes is an experimenter, unless the link says less. Every role stops
the arms.
"""

import hmac
import secrets
from dataclasses import dataclass
from typing import Literal
from urllib.parse import parse_qs

from .page_orders import MoveHand, PageMessage, Seen, StageMessage, StopArms

TOKEN_BYTES = 16


@dataclass(frozen=True, slots=True)
class Role:
    """What somebody may do, and which view of the arms is shown.

    Attributes:
        kind: an experimenter may do everything, a user holds the arm of one site, a watcher does nothing.
        site: as which site the arms are shown; "": as they are, without delay.
    """

    kind: Literal["experimenter", "user", "watcher"] = "experimenter"
    site: str = ""

    def may(self, message: PageMessage) -> bool:
        """True if a message is one that this role may send."""
        if isinstance(message, Seen | StopArms) or self.kind == "experimenter":
            return True
        own = isinstance(message, MoveHand) and message.site == self.site
        return self.kind == "user" and (own or isinstance(message, StageMessage))

    @property
    def query(self) -> str:
        """The query of this role's link."""
        words = ["watch"] if self.kind == "watcher" else []
        return "&".join([*words, f"as={self.site}"] if self.site else words)


class RoleLinks:
    """The links of a page that is served, a token for each role.

    Args:
        guarded: true: a link needs its token.
    """

    def __init__(self, *, guarded: bool) -> None:
        self._secret = secrets.token_bytes(TOKEN_BYTES) if guarded else b""

    def link(self, address: str, role: Role) -> str:
        """Returns the link of a role; its token stands where a browser sends it to no server by itself."""
        query = f"?{role.query}" if role.query else ""
        return f"{address}{query}" + (f"#token={self._make_token(role)}" if self._secret else "")

    def find(self, query: str) -> Role | None:
        """Returns the role of whoever comes by a link with this query; None if no role has its token."""
        asked = parse_qs(query, keep_blank_values=True)
        token, site = (asked.get(key, [""])[0] for key in ("token", "as"))
        able = Role(), Role("user", site), Role("watcher")
        given = next((role for role in able if self._is_token(token, role)), None)
        if given is None or given.kind == "user":
            return given
        if given.kind == "watcher" or "watch" in asked:
            return Role("watcher", site)
        return Role("user", site) if site else given

    def _make_token(self, role: Role) -> str:
        return hmac.digest(self._secret, f"{role.kind} {role.site}".encode(), "sha256")[:TOKEN_BYTES].hex()

    def _is_token(self, token: str, role: Role) -> bool:
        return not self._secret or hmac.compare_digest(token.encode(), self._make_token(role).encode())
