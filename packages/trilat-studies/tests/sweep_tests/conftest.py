"""The judge that stands for the judge of sweeps."""

import pytest
from study_builders import Judge, replace_judge


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> Judge:
    """A judge that keeps the text of each cell."""
    text_judge = Judge()
    replace_judge(monkeypatch, text_judge)
    return text_judge
