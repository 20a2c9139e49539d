"""What differs between two texts, and the text again."""

import json

from hypothesis import given
from hypothesis import strategies as st

from trilat_net.scenario import load_scenario
from trilat_net.studies.sweep.sweep_cell import apply_diff, diff_lines

texts = st.text(alphabet="ab\n ", max_size=60) | st.text(max_size=40)


@given(text=texts, base=texts)
def test_a_text_is_found_again_whatever_it_was_compared_with(text: str, base: str) -> None:
    parts = diff_lines(text, base)
    assert apply_diff(parts, base) == text
    assert apply_diff(json.loads(json.dumps(parts)), base) == text


@given(text=texts, line=st.integers(0, 10), other=st.text(alphabet="xy", min_size=1, max_size=5))
def test_a_line_that_was_changed_is_all_that_differs(text: str, line: int, other: str) -> None:
    lines = text.split("\n")
    lines[line % len(lines)] = other
    own = [part for part in diff_lines("\n".join(lines), text) if isinstance(part, str)]
    assert own in ([other], [])


def test_a_scenario_differs_in_what_an_override_changed() -> None:
    base = load_scenario("p_d_margin")
    changed = load_scenario("p_d_margin", ["sites.m1.control.d=2.5", "seed=7"])
    own = [part for part in diff_lines(changed.text, base.text) if isinstance(part, str)]
    assert own == ["seed = 7", "d = [2.5, 2.5]"]
