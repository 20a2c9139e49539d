"""Completes and checks the dominance factors of one site, a row of the dominance matrix.

Invariant:
    - The factors of a site lie between 0 and 1 and sum to 1, Eq. (7).
"""

from typing import Any

import numpy as np

from ..core import ROW_SUM_TOLERANCE, Array
from ..errors import ScenarioError
from ..fields import TomlTable
from .key_checks import check_keys, is_number


def resolve_dominance_row(written: Any, names: list[str], site: str, path: str) -> TomlTable:
    """Completes the dominance factors of one site.

    Args:
        written: Row as written by its author, or None if there is none. A peer that is not
            named has the factor 0.
        names: Names of all sites of the scenario.
        site: Name of the site to which the row belongs.
        path: Path of the row, for error messages.

    Returns:
        Mapping from peer name to dominance factor.

    Raises:
        ScenarioError: A factor is not a number, or the row as a whole is not valid.
    """
    if written is None:
        raise ScenarioError("is missing; name the sites that this site follows", path=path)
    row = check_keys(written, names, path)
    for peer, factor in row.items():
        if not is_number(factor):
            raise ScenarioError(f"must be a number, but is {factor!r}", path=f"{path}.{peer}")

    factors = {name: float(row.get(name, 0.0)) for name in names}
    row_vector = np.array(list(factors.values()))
    problem = find_row_problem(row_vector, names.index(site))
    if problem:
        raise ScenarioError(problem, path=path)
    del factors[site]
    return factors


def find_row_problem(row: Array, site: int) -> str | None:
    """Checks one row of the dominance matrix, Eq. (7).

    The factors must lie between 0 and 1 and sum to 1, and the arm must not follow itself.

    Args:
        row: Dominance factors of one site, shape (N,).
        site: Index of that site.

    Returns:
        The problem as a clause for an error message, or None if the row is valid.
    """
    if not np.isfinite(row).all():
        return "shares must be finite numbers"
    if row[site] != 0.0:
        return f"a site does not follow itself, yet its own share is {row[site]:g}"
    if (row < 0.0).any() or (row > 1.0).any():
        return "shares must lie between 0 and 1"
    if abs(row.sum() - 1.0) > ROW_SUM_TOLERANCE:
        return f"shares must sum to 1, Eq. (7), and sum to {row.sum():.12g}"
    return None
