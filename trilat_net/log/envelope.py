"""A run of records as two rows of numbers that keep every extreme.

Law: no extreme is lost and none is made up. Every number stands in one row with its smallest value of the run
and in the other with its largest, in the order in which these came: the envelope of a curve is exact. The
envelope of envelopes is the envelope.
"""

from collections.abc import Iterable, Sequence

from ..core.arm import JOINTS
from ..core.tick import Output
from ..net.messages import State
from .standard import mode_number

Record = State | Output
Row = Sequence[float]

JOINT_ROW = slice(0, 4 * JOINTS)
"""Of a row the joints: q, q_des, qd, tau."""
ERROR_ROW = slice(4 * JOINTS, 5 * JOINTS)
"""The error e = q - q_des, Eq. (9)."""
FAST_ROW = slice(0, 5 * JOINTS)
SLOW_ROW = slice(5 * JOINTS, None)
"""The rest: tau_x, theta_hat, mode."""


def envelope(columns: Iterable[Row]) -> tuple[list[float], list[float]]:
    """Returns the smallest and the largest number of each column, the one that came first in the first list.

    Args:
        columns: finite numbers in the order in which they came; one at least in each.
    """
    first, second = [], []
    for column in columns:
        ordered = sorted(column)  # smooth curves are nearly in order: a third of what min and max take
        low, high = ordered[0], ordered[-1]
        start = column[0]
        if start == low or (start != high and column.index(low) < column.index(high)):
            first.append(low)
            second.append(high)
        else:
            first.append(high)
            second.append(low)
    return first, second


def columns_of(records: Sequence[Record]) -> list[Row]:
    """Returns the numbers of records, a column per curve, in the order of the rows above.

    A column may be shorter where all of its numbers are the same.
    """
    rows = [(*m.q, *m.q_des, *m.qd, *m.tau, *m.tau_x, *m.theta_hat) for m in records]
    columns: list[Row] = [*zip(*rows, strict=True)]
    q, q_des = columns[:JOINTS], columns[JOINTS : 2 * JOINTS]
    error = [[a - b for a, b in zip(*pair, strict=True)] for pair in zip(q, q_des, strict=True)]
    modes = [m.mode for m in records]
    if modes.count(modes[0]) == len(modes):
        del modes[1:]
    rest = columns[JOINT_ROW.stop :]
    return [*columns[JOINT_ROW], *error, *rest, [mode_number(mode) for mode in modes]]
