"""What changes during a run: links and shares, by a script or by command.

Law: a change names the time from which it holds and is complete in itself: which link or row it concerns
and all of what that is from then on.
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from .frozen import Frozen
from .link import LinkBase
from .links import Link


class Change(Frozen, frozen=True, omit_defaults=True):
    """One change. Exactly one of `link` and `dominance` is given.

    Attributes:
        at_s: when it takes effect, s after the epoch; on a link, for samples stamped from then on.
        link: the link that it changes, as in "m1->s".
        dominance: the site whose shares it changes.
        to: all that the link is from then on, or all shares of the row.
        ramp_s: how long shares take to change, linearly, s.
    """

    at_s: Annotated[float, Meta(ge=0.0, le=1e6)]
    link: str = ""
    dominance: str = ""
    to: dict[str, Any] = msgspec.field(default_factory=dict)
    ramp_s: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0

    @property
    def start_ns(self) -> int:
        """When it takes effect, ns since the epoch."""
        return round(self.at_s * 1e9)

    @property
    def after(self) -> LinkBase:
        """The link from then on."""
        return msgspec.convert(self.to, Link)  # type: ignore[no-any-return]

    @property
    def shares(self) -> dict[str, float]:
        """The shares at the end of the change."""
        return self.to


def later_links(timeline: Sequence[Change], name: str) -> Iterator[tuple[int, LinkBase]]:
    """Yields what a link becomes, with the first stamp for which it holds, ns, in order."""
    for change in timeline:
        if change.link == name:
            yield change.start_ns, change.after
