"""Counter-based random numbers: a pure function of where they are used, without state or order.

Invariant (L4): a draw is a function of (seed, link, sample index, purpose) and of nothing else;
the same on every machine, in every driver, in any order of arrival.

Philox-4x32 with ten rounds: Salmon, Moraes, Dror and Shaw, "Parallel Random Numbers: As Easy as
1, 2, 3", SC 2011. It is written here because compiled leaves call it per sample; the tests hold
its known-answer vectors.
"""

import hashlib
import math

import numpy as np

from .jit import leaf

_M0 = np.uint64(0xD2511F53)
_M1 = np.uint64(0xCD9E8D57)
_W0 = np.uint64(0x9E3779B9)
_W1 = np.uint64(0xBB67AE85)
_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)
_ROUNDS = 10

_TO_26 = np.uint64(6)
_TWO_26 = 67_108_864.0
_TWO_52 = 4_503_599_627_370_496.0

PhiloxWords = tuple[np.uint64, np.uint64, np.uint64, np.uint64]
DrawKey = np.uint64


def link_key(seed: int, link: str) -> int:
    """Returns the 64-bit key of the draws of a link, named as in "m1->s"."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{link}".encode()).digest()[:8], "little")


@leaf
def philox(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> PhiloxWords:
    """Returns four 32-bit words for a 128-bit counter and a 64-bit key, all as 32-bit words in
    uint64.
    """
    for _ in range(_ROUNDS):
        p0 = _M0 * c0
        p1 = _M1 * c2
        c0 = (p1 >> _SHIFT) ^ c1 ^ k0
        c1 = p1 & _LOW
        c2 = (p0 >> _SHIFT) ^ c3 ^ k1
        c3 = p0 & _LOW
        k0 = (k0 + _W0) & _LOW
        k1 = (k1 + _W1) & _LOW
    return c0, c1, c2, c3


@leaf
def unit_interval(high: np.uint64, low: np.uint64) -> float:
    """Returns a number of the open interval (0, 1) from two 32-bit words: 52 bits, then a half,
    exactly.

    With 53 bits the largest one would round to 1.
    """
    return (float(high >> _TO_26) * _TWO_26 + float(low >> _TO_26) + 0.5) / _TWO_52


@leaf
def uniforms(key: DrawKey, sample: int, purpose: int, attempt: int) -> tuple[float, float]:
    """Returns two numbers, uniform on the open interval (0, 1).

    Draws of different purposes are independent; `attempt` counts those of a method that rejects
    some.
    """
    index = np.uint64(sample)
    a, b, c, d = philox(
        c0=index & _LOW,
        c1=index >> _SHIFT,
        c2=np.uint64(purpose),
        c3=np.uint64(attempt),
        k0=key & _LOW,
        k1=key >> _SHIFT,
    )
    return unit_interval(a, b), unit_interval(c, d)


@leaf
def standard_normal(key: DrawKey, sample: int, purpose: int, attempt: int) -> float:
    """Returns a standard normal number, by the method of Box and Muller; arguments as in
    `uniforms`.
    """
    u, v = uniforms(key, sample, purpose, attempt)
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * v)


@leaf
def standard_gamma(key: DrawKey, sample: int, purpose: int, shape: float) -> float:
    """Returns a gamma number of the given shape and scale 1.

    By rejection: Marsaglia and Tsang, "A Simple Method for Generating Gamma Variables", ACM
    TOMS 26 (2000); below shape 1 by their boost from shape + 1. It uses up `purpose + 1` and
    `purpose + 2` as well.
    """
    boost = 1.0
    k = shape
    if k < 1.0:
        u, _ = uniforms(key, sample, purpose + 2, 0)
        boost = u ** (1.0 / k)
        k += 1.0
    d = k - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)
    for attempt in range(64):  # one in twenty is rejected at most: 64 in a row never happen
        x = standard_normal(key, sample, purpose, attempt)
        root = 1.0 + c * x
        v = root * root * root
        u, _ = uniforms(key, sample, purpose + 1, attempt)
        if v > 0.0 and math.log(u) < 0.5 * x * x + d - d * v + d * math.log(v):
            return boost * d * v
    return boost * d
