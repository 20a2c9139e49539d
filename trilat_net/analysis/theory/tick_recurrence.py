"""Compiled inner loop of the linear model over ticks, where `floquet` spends most of its time.

A linear model of N sites computes the state of each site tick by tick from its own previous
state and from samples of its peers. The matrices have about eight rows. At this size, calls to
a linear algebra library would take ten times as long as the products themselves.
"""

from ...core import Array, IntArray, leaf


@leaf
def add_matrix_products(states: Array, matrix: Array, track: Array, rows: IntArray) -> None:
    """Adds the products of a matrix with earlier states to the states of consecutive ticks.

    For k = 0, 1, ..., the function computes states[k] += matrix @ track[rows[k]]. `states` may
    be a part of `track`: a tick may then use the states of the previous tick, which are already
    complete.

    Args:
        states: States of K ticks, shape (K, n, columns), with one motion per column. Modified
            in place.
        matrix: Matrix, shape (n, m).
        track: States of a site in all ticks, shape (ticks, m, columns).
        rows: Row of the track that each tick uses, shape (K,).
    """
    n, m = matrix.shape
    columns = states.shape[2]
    for k in range(rows.shape[0]):
        state = states[k]
        sample = track[rows[k]]
        for i in range(n):
            for j in range(m):
                factor = matrix[i, j]
                # The innermost loop over columns becomes vector instructions.
                for column in range(columns):
                    state[i, column] += factor * sample[j, column]
