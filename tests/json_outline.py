"""The keys and types of results' JSON, as docs/data/json-keys.csv has them (`tests.json_samples`)."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TABLE = Path(__file__).parents[1] / "docs" / "data" / "json-keys.csv"
_KINDS = {bool: "boolean", int: "number", float: "number", str: "text", type(None): "null"}
_NAMED = re.compile(
    r"\.(sites|links|walls|judged|records|parameters|channels|remarks|means|unknown|edges|q_rad|x|theta_hat"
    r"|delay_in_use_ms|passive_qd_of_joint|versions|accounts|compression|attachments"
    r"|beta_first|beta_last|parts_last_j|taken_j|given_j|causes_j|sites_unexplained_max_j|part|ended|torque_nm|weight"
    r"|metadata|absent|orders|coverage|counts|laws|gains|gains\[\]\.gains|outcomes|tau_limit_nm|study\.conditions|exclusions)$"
)
"""Tables whose keys are names."""


def read_keys(command: str) -> list[str]:
    """Returns the keys that the table has of a command, as in "certify"."""
    rows = (line.split(",") for line in TABLE.read_text(encoding="utf-8").splitlines())
    return [key for name, key, _ in rows if name == f"trilat {command}"]


def is_documented(command: str, value: Any) -> bool:
    """True if the table has every key of a result, as it is, or with more below it."""
    keys = read_keys(command)
    return all(
        any(f"{key}.".startswith((f"{path}.", f"{path}[")) for key in keys)
        for path in gather_types([value])
    )


def iterate_outline(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yields the path of every key that holds no further ones, and its type."""
    if isinstance(value, dict) and value:
        for key, below in value.items():
            texts = path == ".session" and all(isinstance(item, str) for item in value.values())
            named = texts or bool(_NAMED.search(path))
            yield from iterate_outline(below, f"{path}.{'*' if named else key}")
    elif isinstance(value, list | tuple) and value:
        for below in value:
            yield from iterate_outline(below, f"{path}[]")
    else:
        yield path, _KINDS.get(type(value), "table" if isinstance(value, dict) else "list")


def gather_types(values: list[Any]) -> dict[str, str]:
    """Returns the types of all keys of several samples."""
    kinds: dict[str, set[str]] = {}
    for sample in values:
        for path, kind in iterate_outline(sample):
            kinds.setdefault(path.removeprefix("."), set()).add(kind)
    return {path: " or ".join(sorted(kinds[path])) for path in sorted(kinds)}
