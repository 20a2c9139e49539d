"""The mutants that judge the tests: each changes one token and is drawn by a seed."""

import ast
import io
import tokenize

import pytest

from . import house
from .mutants import draw_mutants


@pytest.mark.parametrize("seed", range(3))
def test_a_mutant_is_one_token_of_code(seed: int) -> None:
    mutants = draw_mutants(seed, 40)
    assert mutants == draw_mutants(seed, 40)
    assert len(set(mutants)) == 40
    for mutant in mutants:
        before, after = (
            [
                token.string
                for token in tokenize.generate_tokens(io.StringIO(text).readline)
                if token.string.strip()
            ]
            for text in (mutant.path.read_text(encoding="utf-8"), mutant.apply())
        )
        at = next(n for n, line in enumerate(before) if after[n] != line)
        assert before[at] == mutant.was
        assert [*before[:at], *([mutant.now] if mutant.now else []), *before[at + 1 :]] == after
        ast.parse(mutant.apply())
    assert {house.room(mutant.path) for mutant in mutants} == {"core", "log", "analysis"}
