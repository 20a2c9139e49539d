"""Format in which a log stores changes during a run, for example of a link delay.

Each site stores one record per tick, which contains every change applied in that tick as a JSON
string. The types of this module allow programs that only forward or store records to parse
these strings without the scenario.
"""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

SiteOrder = Literal[
    "",
    "stop",
    "enable",
    "reset",
    "overrun",
    "arm_silent",
    "arm_lost",
    "arm_back",
    "released",
    "held",
]
"""Commands that change the mode of a site. An empty string means that there is no command.

Users send "stop", "enable" and "reset". The others are issued by the site itself, for example
"arm_lost" if no measurement has arrived from its robot.
"""


class RecordedChange(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True
):
    """A change during a run as recorded in a log, for example a new network delay.

    The change concerns a link or the dominance factors of a site, or is a command to a site.
    Exactly one of `link`, `dominance` and `site` is not empty. The values are not validated;
    `change.Change` is the validated form.

    Attributes:
        at_s: Time at which the change takes effect, in s since the start of the session. A
            change of a link affects samples that are sent at this time or later.
        link: Name of the link that changes, for example "m1->s".
        dominance: Name of the site whose dominance factors change.
        to: State after the change: all keys of the link, or the factors of all peers.
        ramp_s: Duration of the linear transition to the new factors, in s.
        site: Name of the site that receives a command.
        order: The command. See `core.step.ticks.LifeOrder`.
        ticks: For the command "overrun": number of ticks that the site missed.
    """

    at_s: Annotated[float, Meta(ge=0.0, le=1e6)]
    link: str = ""
    dominance: str = ""
    to: dict[str, Any] = msgspec.field(default_factory=dict)
    ramp_s: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    site: str = ""
    order: SiteOrder = ""
    ticks: Annotated[int, Meta(ge=0, lt=2**40)] = 0
