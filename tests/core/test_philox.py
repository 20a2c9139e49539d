"""Random numbers as a function of their place (L4)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from tests.core.philox_reference import U32, make_table, philox_in_integers
from trilat_net.core.links.philox import link_key, philox, uniforms, unit_interval

u32 = st.integers(0, U32)


def draw_words(counter: tuple[int, ...], key: tuple[int, int]) -> list[int]:
    return [int(word) for word in philox(*map(np.uint64, (*counter, *key)))]


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((U32,) * 4, (U32,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_the_known_answers_of_random123(
    counter: tuple[int, ...], key: tuple[int, int], answer: tuple[int, ...]
) -> None:
    """philox4x32-10 of the library's kat_vectors."""
    assert draw_words(counter, key) == list(answer)
    assert philox_in_integers(counter, key) == list(answer)


@given(counter=st.tuples(u32, u32, u32, u32), key=st.tuples(u32, u32))
def test_any_counter_and_key_as_defined(counter: tuple[int, ...], key: tuple[int, int]) -> None:
    assert draw_words(counter, key) == philox_in_integers(counter, key)


@given(
    key=st.integers(0, 2**64 - 1),
    sample=st.integers(0, 2**40),
    purpose=u32,
    attempt=st.integers(0, 63),
)
def test_uniforms_follow_from_their_place(
    key: int, sample: int, purpose: int, attempt: int
) -> None:
    a, b, c, d = philox_in_integers(
        (sample & U32, sample >> 32, purpose, attempt), (key & U32, key >> 32)
    )
    expected = (
        ((a >> 6 << 26) + (b >> 6) + 0.5) / 2**52,
        ((c >> 6 << 26) + (d >> 6) + 0.5) / 2**52,
    )
    assert uniforms(np.uint64(key), sample, purpose, attempt) == expected


def test_the_ends_of_the_open_interval() -> None:
    assert unit_interval(np.uint64(0), np.uint64(0)) == 2.0**-53
    assert unit_interval(np.uint64(U32), np.uint64(U32)) == 1.0 - 2.0**-53


def test_links_and_seeds_have_keys_of_their_own() -> None:
    keys = {
        link_key(seed, link)
        for seed in range(20)
        for link in ("m1->s", "s->m1", "m2->s", "m1->s2")
    }
    assert len(keys) == 80
    assert all(0 <= key < 2**64 for key in keys)


def is_likely(numbers: NDArray[np.float64], distribution: stats.rv_continuous) -> bool:
    return bool(stats.kstest(numbers, distribution.cdf).pvalue > 1e-4)


def test_uniforms_are_uniform_and_their_pairs_independent() -> None:
    u = make_table(200_000, 0)
    assert is_likely(u, stats.uniform())
    assert is_likely((u[:200_000] + u[200_000:]) % 1.0, stats.uniform())
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 4 / np.sqrt(len(u))
    assert abs(np.corrcoef(u[:200_000], u[200_000:])[0, 1]) < 4 / np.sqrt(200_000)


def test_normal_numbers_are_normal() -> None:
    assert is_likely(make_table(200_000, 1), stats.norm())


@pytest.mark.parametrize("shape", [0.01, 0.3, 0.999, 1.0, 1.5, 4.0, 1e6])
def test_gamma_numbers_are_gamma(shape: float) -> None:
    assert is_likely(make_table(200_000, 2, shape), stats.gamma(shape))
