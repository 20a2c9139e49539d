"""Reads the measured mass, damping and stiffness of a person's hand from a file.

`trilat identify hand --json` measures how a hand reacts to forces and writes the file. The
analysis of ports (`port_passivity`) can then check whether coupled arms are stable with this
hand, instead of with every passive operator.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import UsageError
from .port_passivity import HandMatrices

_KEYS = ("mass_kg", "damping_n_s_m", "stiffness_n_m")
"""Keys of the mass, damping and stiffness matrix in a file."""


def read_hands(files: Sequence[str | Path]) -> list[HandMatrices]:
    """Reads the mass, damping and stiffness of human hands that were measured before.

    Stability can then be checked against these hands instead of every passive operator, which
    is less strict.

    Args:
        files: Paths of JSON files that `trilat identify hand --json` wrote.

    Returns:
        The mass, damping and stiffness matrices of each hand, in the order of the files.

    Raises:
        UsageError: A file does not contain a hand.
    """
    return [_read_hand(Path(file)) for file in files]


def _read_hand(file: Path) -> HandMatrices:
    """Reads the measured dynamics of a human hand from a JSON file.

    Args:
        file: Path of the file.

    Raises:
        UsageError: The file does not contain the dynamics of a hand.
    """
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        M, B, K = (np.array(values[key], dtype=np.float64) for key in _KEYS)
        have_same_shape = M.shape == B.shape == K.shape
        if not have_same_shape or M.shape not in ((2, 2), (3, 3)):
            raise ValueError("the matrices must all have 2 rows and columns, or all have 3")
        if not np.isfinite([M, B, K]).all():
            raise ValueError("a number is not finite")
    except (OSError, ValueError, KeyError, TypeError) as error:
        problem = str(error)
        # The text of a KeyError is only the key.
        if isinstance(error, KeyError):
            problem = f"the key {error} is missing"
        raise UsageError(
            f"{file}: does not contain the output of `trilat identify hand --json`: {problem}"
        ) from None
    return HandMatrices(M, B, K)
