"""A data frame is the table: names, numbers bit for bit, null where there is none."""

import sys

import polars as pl
import pytest

from tests.analysis import logs
from tests.log_editing import opened, recorded
from trilat_net.errors import UsageError


@pytest.mark.parametrize(("name", "kind"), [("a", ""), ("a", "link"), ("b", "arrivals"), ("events", "")])
def test_a_frame_is_its_table(name: str, kind: str) -> None:
    log = logs.busy().log
    table, frame = log.table(name, kind), log.frame(name, kind)
    assert frame.columns == [column.name for column in table.columns]
    assert frame.height == len(table)
    for column in table.columns:
        assert frame[column.name].to_list() == column.rows(0, len(table))


def test_columns_are_of_their_kinds() -> None:
    schema = opened(recorded("paper")).frame("m1").schema
    assert schema["mode"] == pl.String
    assert (schema["tick"], schema["log_time_ns"], schema["used_s_tick"]) == (pl.Int64,) * 3
    assert (schema["t_s"], schema["q1_rad"], schema["age_s_ms"]) == (pl.Float64,) * 3


def test_one_figures_worth_of_a_frame() -> None:
    """As a person would use it: how old were the samples of the slave, once there was one?"""
    frame = opened(recorded("paper")).frame("m1")
    ages = frame.select(pl.col("age_s_ms").drop_nulls())
    assert ages.height == 100
    assert ages["age_s_ms"].unique().to_list() == pytest.approx([20.0])


def test_without_polars_one_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(UsageError, match=r"data frames need polars: pip install 'trilat-net\[frames\]'"):
        opened(recorded("paper")).frame("m1")
