"""Draws random numbers as stateless functions of their arguments.

A conventional generator updates a state, so its output depends on the order of the draws. This
counter-based generator encrypts a counter instead.

Invariant (L4):
    - A draw depends only on the seed, the link, the index of the sample on the link and the
      purpose of the draw. It is therefore the same on every machine, in simulated and in real
      time, and for any order in which samples arrive.

The generator is Philox-4x32 with ten rounds: Salmon, Moraes, Dror and Shaw, "Parallel Random
Numbers: As Easy as 1, 2, 3", SC 2011. NumPy also provides Philox, but the core draws numbers
for each sample in compiled functions. Tests compare this implementation with published results.
"""

import hashlib
import math

import numpy as np

from ..step.jit import leaf

# The multipliers of the rounds (M) and the increments of the key (W), as in the paper.
_M0 = np.uint64(0xD2511F53)
_M1 = np.uint64(0xCD9E8D57)
_W0 = np.uint64(0x9E3779B9)
_W1 = np.uint64(0xBB67AE85)
_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)
_ROUNDS = 10

# A shift that leaves the upper 26 of 32 bits, and powers of 2.
_TO_26 = np.uint64(6)
_TWO_26 = 67_108_864.0
_TWO_52 = 4_503_599_627_370_496.0

PhiloxWords = tuple[np.uint64, np.uint64, np.uint64, np.uint64]
DrawKey = np.uint64


def link_key(seed: int, link: str) -> int:
    """Returns the key from which all random numbers of a network link are computed.

    The key depends on the seed of the run and the name of the link. Two links therefore have
    independent delays, and another run with the same seed has the same delays.

    Args:
        seed: Seed of the experiment.
        link: Name of the link, for example "m1->s".

    Returns:
        An unsigned 64-bit integer.
    """
    digest = hashlib.sha256(f"{seed}/{link}".encode()).digest()
    return int.from_bytes(digest[:8], "little")


@leaf
def philox(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> PhiloxWords:
    """Returns four random 32-bit words for a counter and a key, using the Philox generator.

    The same arguments always give the same words, so the generator needs no state. All words
    are 32-bit values stored in uint64, so that products keep their upper halves.

    Args:
        c0: Lowest word of the 128-bit counter.
        c1: Second word of the counter.
        c2: Third word of the counter.
        c3: Highest word of the counter.
        k0: Lower word of the 64-bit key.
        k1: Upper word of the key.
    """
    for _ in range(_ROUNDS):
        product_0 = _M0 * c0
        product_1 = _M1 * c2
        upper_0 = product_0 >> _SHIFT
        upper_1 = product_1 >> _SHIFT
        c0 = upper_1 ^ c1 ^ k0
        c1 = product_1 & _LOW
        c2 = upper_0 ^ c3 ^ k1
        c3 = product_0 & _LOW
        k0 = (k0 + _W0) & _LOW
        k1 = (k1 + _W1) & _LOW
    return c0, c1, c2, c3


@leaf
def unit_interval(high: np.uint64, low: np.uint64) -> float:
    """Converts two random 32-bit words to a number in the open interval (0, 1).

        (52 random bits + 1/2) / 2^52

    The result is exact. With 53 random bits, the largest value would be rounded to 1.

    Args:
        high: Word that provides the upper bits.
        low: Word that provides the lower bits.
    """
    upper_bits = float(high >> _TO_26) * _TWO_26
    lower_bits = float(low >> _TO_26)
    return (upper_bits + lower_bits + 0.5) / _TWO_52


@leaf
def uniforms(key: DrawKey, sample: int, purpose: int, attempt: int) -> tuple[float, float]:
    """Returns two random numbers, uniformly distributed on the open interval (0, 1).

    The numbers are a function of the arguments, so a run can be repeated. Draws with different
    arguments are independent.

    Args:
        key: Key of the link.
        sample: Index of the sample for which the numbers are drawn.
        purpose: Distinguishes several draws for the same sample.
        attempt: Number of the attempt, starting at 0, for a method that rejects some draws.
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
    """Returns a normally distributed random number with mean 0 and standard deviation 1.

    Uses the Box-Muller method. The same arguments always give the same number.

    Args:
        key: Key of the link.
        sample: Index of the sample for which the number is drawn.
        purpose: Distinguishes several draws for the same sample.
        attempt: Number of the attempt, starting at 0, for a method that rejects some draws.
    """
    u, v = uniforms(key, sample, purpose, attempt)
    radius = math.sqrt(-2.0 * math.log(u))
    angle = 2.0 * math.pi * v
    return radius * math.cos(angle)


@leaf
def standard_gamma(key: DrawKey, sample: int, purpose: int, shape: float) -> float:
    """Draws a random number from a gamma distribution with scale 1.

    Uses the rejection method of Marsaglia and Tsang, "A Simple Method for Generating Gamma
    Variables", ACM TOMS 26 (2000), in the notation of that paper. If the shape k is below 1, a
    number with shape k + 1 is drawn and multiplied by u^(1 / k), where u is uniform from 0 to
    1.

    Args:
        key: Key of the link.
        sample: Index of the sample for which the number is drawn.
        purpose: Distinguishes several draws for the same sample. The draw uses the streams
            `purpose`, `purpose + 1` and `purpose + 2`.
        shape: Shape k of the distribution.
    """
    boost = 1.0
    k = shape
    if k < 1.0:
        u, _ = uniforms(key, sample, purpose + 2, 0)
        boost = u ** (1.0 / k)
        k += 1.0
    d = k - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)
    # At most one attempt in twenty is rejected, so 64 rejections in a row never happen.
    for attempt in range(64):
        x = standard_normal(key, sample, purpose, attempt)
        root = 1.0 + c * x
        v = root * root * root
        u, _ = uniforms(key, sample, purpose + 1, attempt)
        if v <= 0.0:
            continue
        log_acceptance = 0.5 * x * x + d - d * v + d * math.log(v)
        if math.log(u) < log_acceptance:
            return boost * d * v
    return boost * d
