"""Logs that are refused: files of other programs, and logs with a changed scenario or record."""

import io
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.log.builders import edit_log_bytes, make_log_bytes
from tests.refusals.corpus import Case, names_file, parametrize_cases
from trilat_net.errors import LogError
from trilat_net.log.log_reader import Log, open_log


class LogCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A file that is no log, or a short log of the scenario paper with changes."""

    hex: str | None = None
    """Content of the file in hexadecimal digits. None for a changed log."""
    record: dict[str, Any] = msgspec.field(default_factory=dict)
    """New values of fields of the records of tick 5."""
    scenario: str = ""
    """Text of the scenario in the log."""

    def make_content(self) -> bytes:
        """Returns the content of the file."""
        if self.hex is not None:
            return bytes.fromhex(self.hex)
        return edit_log_bytes(
            make_log_bytes("paper"),
            record=lambda record: {**record, **self.record} if record["tick"] == 5 else record,
            scenario=lambda text: self.scenario or text,
        )


def read_all(log: Log) -> None:
    """Reads all records and arrivals of a log."""
    for site in log.sites:
        assert len(log[site].states) == len(log.table(site, "arrivals"))


@parametrize_cases("logs.toml", LogCase)
def test_wrong_logs_are_refused(case: LogCase, tmp_path: Path) -> None:
    """A log is refused alike if the log is in a file, which the message names, or in memory."""
    content = case.make_content()
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    for source in (path, io.BytesIO(content)):
        with pytest.raises(LogError) as caught:
            read_all(open_log(source))
        message = str(caught.value)
        assert source != path or names_file(message, path)
        case.check_message(message, caught.value.exit_code)
