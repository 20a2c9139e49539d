"""The base of a scenario's types."""

import msgspec


class Frozen(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Immutable; unknown keys are refused."""
