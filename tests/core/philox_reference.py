"""Tables of draws, and an independent version of the generator in integers."""

import numpy as np
from numpy.typing import NDArray

from trilat_net.core.links.philox import standard_gamma, standard_normal, uniforms
from trilat_net.core.step.jit import leaf

U32 = 2**32 - 1


def philox_in_integers(counter: tuple[int, ...], key: tuple[int, int]) -> list[int]:
    """Computes Philox by the definition of the paper, in Python's own integers."""
    c = list(counter)
    k = list(key)
    for _ in range(10):
        a = 0xD2511F53 * c[0]
        b = 0xCD9E8D57 * c[2]
        c = [(b >> 32) ^ c[1] ^ k[0], b & U32, (a >> 32) ^ c[3] ^ k[1], a & U32]
        k = [(k[0] + 0x9E3779B9) & U32, (k[1] + 0xBB67AE85) & U32]
    return c


@leaf
def _fill_table(
    key: np.uint64, count: int, kind: int, shape: float, numbers: NDArray[np.float64]
) -> None:
    for n in range(count):
        if kind == 0:
            numbers[n], numbers[count + n] = uniforms(key, n, 3, 0)
        elif kind == 1:
            numbers[n] = standard_normal(key, n, 2, 0)
        else:
            numbers[n] = standard_gamma(key, n, 2, shape)


def make_table(count: int, kind: int, shape: float = 0.0, key: int = 77) -> NDArray[np.float64]:
    numbers = np.zeros(2 * count)
    _fill_table(np.uint64(key), count, kind, shape, numbers)
    return numbers if kind == 0 else numbers[:count]
