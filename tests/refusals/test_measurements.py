"""Files of measured delays that cannot be imported as a trace."""

from pathlib import Path

import pytest

from tests.refusals.corpus import Case, parametrize_cases
from trilat_net.errors import ScenarioError
from trilat_net.scenario.delay_traces import import_trace


class MeasurementCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The text of a file that a program or a user wrote, with the format that a user states."""

    form: str
    text: str
    way: str = ""
    """How the delay follows from the file, as in "whole". Empty for the default."""


@parametrize_cases("measurements.toml", MeasurementCase)
def test_wrong_measurements_are_refused(case: MeasurementCase, tmp_path: Path) -> None:
    (tmp_path / "delays.txt").write_text(case.text, encoding="utf-8")
    with pytest.raises(ScenarioError) as caught:
        import_trace(tmp_path / "delays.txt", case.form, way=case.way)
    case.check_message(str(caught.value), caught.value.exit_code)
