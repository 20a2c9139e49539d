"""A law that sends many separate quantities, for tests of the size of views."""

from typing import ClassVar

from trilat_net.core.plug.user_law import LawContext, LawInput


class Wide:
    """Gravity compensation that sends sixteen quantities of one number to all peers."""

    sends: ClassVar = {
        "n0": {"unit": "J", "length": 1},
        "n1": {"unit": "J", "length": 1},
        "n2": {"unit": "J", "length": 1},
        "n3": {"unit": "J", "length": 1},
        "n4": {"unit": "J", "length": 1},
        "n5": {"unit": "J", "length": 1},
        "n6": {"unit": "J", "length": 1},
        "n7": {"unit": "J", "length": 1},
        "n8": {"unit": "J", "length": 1},
        "n9": {"unit": "J", "length": 1},
        "n10": {"unit": "J", "length": 1},
        "n11": {"unit": "J", "length": 1},
        "n12": {"unit": "J", "length": 1},
        "n13": {"unit": "J", "length": 1},
        "n14": {"unit": "J", "length": 1},
        "n15": {"unit": "J", "length": 1},
    }

    def __init__(self, facts: LawContext) -> None:
        """Needs nothing from the context."""

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            now.tau[i] = now.gravity[i]
