"""What the program of an arm outside tells its site: where the arm is.

Law: a site takes the newest measurement at each of its ticks, and its record's q and qd are that; so these
messages need no log of their own.
"""

import msgspec

from ..core.arm import JOINTS
from .messages import U64, VERSION, Angles, Instant, Speeds, TickNumber

MEASUREMENT_VECTORS = {"q": JOINTS, "qd": JOINTS}


class Measurement(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One measurement of an arm.

    Attributes:
        v: version of this schema.
        site: whose arm it is.
        boot: the start of the arm's program, random: a site listens to one of them.
        n: which measurement of that start it is, from 0.
        q: joint angles.
        qd: joint velocities.
        sent_ns: when it was sent, ns of the program's own monotonic clock.
    """

    v: int = VERSION
    site: str
    boot: U64
    n: TickNumber
    q: Angles
    qd: Speeds
    sent_ns: Instant
