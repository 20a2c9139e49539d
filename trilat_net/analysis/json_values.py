"""Values of JSON objects: what programs read of a log, a run and its certificate.

Invariant: JSON has no words for NaN and infinity; a quantity that is not known is null.
"""

import math
from typing import Any

JsonObject = dict[str, Any]


def finite_or_none(value: float) -> float | None:
    """Returns a number for JSON; None for NaN and infinity."""
    return value if math.isfinite(value) else None
