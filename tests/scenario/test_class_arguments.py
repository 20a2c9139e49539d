"""Arguments of a user's class are checked before the class runs."""

from functools import partial
from typing import Any

import pytest

import tests.own_laws
from trilat_net.errors import ScenarioError
from trilat_net.own_code.class_arguments import make_own_instance


class Any1:
    def __init__(
        self, facts: object, K: float = 1.0, name: str = "a", **others: object
    ) -> None:
        self.settings = (facts, K, name, others)


class Needs:
    def __init__(self, facts: object, K: float, *, count=3, name="x") -> None:  # type: ignore[no-untyped-def]
        self.settings = (facts, K, count, name)


def refusal(kind: Any, **settings: Any) -> str:
    with pytest.raises(ScenarioError) as refused:
        make_own_instance(kind, "mine:Kind", None, settings, "sites.s.control")
    assert refused.value.path == "sites.s.control"
    return str(refused.value)


def test_unknown_arguments_are_named_with_known_ones() -> None:
    text = refusal(tests.own_laws.PD, k=3)
    assert "mine:Kind" in text
    assert "own_laws.py" in text
    assert "no argument k; its __init__ takes the arguments K, d, gravity" in text
    assert "did you mean 'K'?" in text


@pytest.mark.parametrize(
    ("kind", "settings", "fact"),
    [
        (Any1, {"K": "abc"}, "its argument K must be a number, but is 'abc'"),
        (Any1, {"K": [1.0]}, "its argument K must be a number"),
        (Any1, {"name": 3}, "its argument name must be a text, but is 3"),
        (Needs, {}, "needs a value for its argument K"),
        (Needs, {"K": 1, "count": "many"}, "its argument count must be a number"),
        (Needs, {"K": 1, "other": 2}, "takes the arguments K, count, name"),
    ],
)
def test_wrong_arguments_are_refused(kind: Any, settings: Any, fact: str) -> None:
    assert fact in refusal(kind, **settings)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (Any1, {"K": 1, "anything": [2]}),
        (Needs, {"K": 1, "count": [1, 2], "name": "y"}),  # no annotation: lists may be meant
        (partial(Any1), {"K": True}),
    ],
)
def test_right_arguments_reach_the_class(kind: Any, settings: Any) -> None:
    instance = make_own_instance(kind, "mine:Kind", "facts", settings, "sites.s.control")
    assert instance.settings[0] == "facts"
    assert instance.settings[1] == 1


def test_failures_inside_the_class_keep_their_text() -> None:
    class Broken:
        def __init__(self, _facts: object) -> None:
            raise RuntimeError("no motor")

    with pytest.raises(ScenarioError, match="RuntimeError: no motor"):
        make_own_instance(Broken, "mine:Kind", "facts", {}, "sites.s.plant")
