"""The built-in control laws, one per file.

A control law computes the torque of an arm from the motion of this arm and of the other arms. A
scenario selects a law by name, for example `law = "four_channel"`.

Invariant:
    - The names of a law's file and class correspond: `four_channel.py` contains `FourChannel`.
    - A built-in law is written in the same way as a user's law (docs/extend/own-controller.md).
      Its method `torque` is compiled, so it uses loops over numbers and creates no lists.
    - Other modules find the laws by listing this folder (see `scenario.laws`).
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # The interface of a law
    "DAMPING",
    "ERROR_DAMPING",
    "ControlLaw",
    "GainRange",
    "LawSettings",
    "SentVectorSpecs",
    "TuningRun",
    "TuningSite",
    "convert_sends",
    # Conditions of stability
    "COMMON_MOTION_SHARE",
    "BlockKey",
    "LawSituation",
    "StabilityCondition",
    "LinearForm",
]

if TYPE_CHECKING:
    from .conditions import (
        COMMON_MOTION_SHARE,
        BlockKey,
        LawSituation,
        LinearForm,
        StabilityCondition,
    )
    from .interface import (
        DAMPING,
        ERROR_DAMPING,
        ControlLaw,
        GainRange,
        LawSettings,
        TuningRun,
        TuningSite,
    )
    from .sent_vectors import SentVectorSpecs, convert_sends
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "conditions": (
                "BlockKey COMMON_MOTION_SHARE LawSituation LinearForm StabilityCondition"
            ),
            "interface": (
                "ControlLaw DAMPING ERROR_DAMPING GainRange LawSettings TuningRun TuningSite"
            ),
            "sent_vectors": "SentVectorSpecs convert_sends",
        },
    )
