"""Traces from tables: accepted files, and refusals."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.core.links.channel import LOST
from trilat_net.core.links.delay import MAX_DELAY_US, LinkModel
from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario, parse_scenario
from trilat_net.scenario.delay_traces import (
    MAX_TRACE_POINTS,
    format_trace,
    parse_trace,
    read_trace,
)
from trilat_net.scenario.scenario_reader import read_shipped

POINTS = [[0, 41_200], [1_000, LOST], [2_500, 0]]
TEXT = "0 41200, 1000 lost, 2500 0"


@pytest.mark.parametrize(
    "content",
    [
        "t_s,delay_ms\n0.000,41.2\n0.001,lost\n0.0025,0\n",
        "0.000,41.2\n0.001,lost\n0.0025,0",
        "time,delay\r\n0.000,41.2\r\n0.001,lost\r\n0.0025,0\r\n",
        "# measured in May\n\nt_s,delay_ms\n# by hand\n 0.000 , 41.2\n0.001, lost \n\n0.0025,0.0\n",
        '"t_s","delay_ms"\n"0.000","41.2"\n"0.001","lost"\n"0.0025","0"\n',
        "\ufefft_s,delay_ms\n0,41.2\n1e-3,lost\n2.5e-3,0\n",
        "t_s,delay_ms\n17.000,41.2\n17.001,lost\n17.0025,0\n",  # times count from the first point
    ],
)
def test_tables_from_people_are_read(tmp_path: Path, content: str) -> None:
    (tmp_path / "delays.csv").write_bytes(content.encode())
    text = read_trace(tmp_path / "delays.csv", "m1->s")
    assert text == TEXT
    assert parse_trace(text).tolist() == POINTS


rows = st.lists(
    st.tuples(st.integers(1, 10**8), st.integers(0, MAX_DELAY_US) | st.just(LOST)),
    min_size=1,
    max_size=30,
)


@given(rows=rows)
def test_traces_keep_microseconds(rows: list[tuple[int, int]]) -> None:
    t_us = np.cumsum([gap for gap, _ in rows])
    delays = [delay for _, delay in rows]
    table = [
        (t / 1e6, math.inf if us == LOST else us / 1e3)
        for t, us in zip(t_us.tolist(), delays, strict=True)
    ]
    text = format_trace(table)
    assert parse_trace(text).tolist() == [
        [t - t_us[0], us] for t, us in zip(t_us, delays, strict=True)
    ]


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "latin.csv").write_bytes(b"t_s,delay_ms # \xe4\n0,5\n")
    (tmp_path / "long.csv").write_text("0," + "5" * 200_000, encoding="utf-8")
    for name, reason in (
        ("none.csv", "cannot be read: No such file"),
        ("", "cannot be read: the path is a folder, not a file"),
        ("latin.csv", "can't decode"),
        ("long.csv", "field larger than field limit"),
        ("a\0b.csv", "null byte"),
    ):
        with pytest.raises(ScenarioError, match=reason):
            read_trace(tmp_path / name, "m1->s")


def test_overlong_traces_are_refused() -> None:
    with pytest.raises(ValueError, match="has 200001 points, but at most 200000"):
        format_trace([(n / 1000, 5.0) for n in range(MAX_TRACE_POINTS + 1)])


# In a scenario.


def make_trace_scenario(folder: Path, link: str) -> Any:
    text = read_shipped("paper").replace("[link]\ndelay_ms = 200.0", link)
    return parse_scenario(text, "mine", folder=folder)


def test_files_lie_beside_their_scenario(tmp_path: Path) -> None:
    (tmp_path / "delays.csv").write_text("0,41.2\n0.001,lost\n0.0025,0\n", encoding="utf-8")
    loaded = make_trace_scenario(
        tmp_path, '[link]\nmodel = "trace"\nfile = "delays.csv"\nat_end = "loop"'
    )
    assert {link.trace for link in loaded.links.values()} == {TEXT}
    assert "delays.csv" not in loaded.text
    assert parse_scenario(loaded.text) == loaded
    (path := tmp_path / "mine.toml").write_text(
        read_shipped("paper").replace(
            "delay_ms = 200.0", 'model = "trace"\nfile = "delays.csv"'
        ),
        "utf-8",
    )
    assert load_scenario(path).links["m1->s"].trace == TEXT
    setup = loaded.setup("s").links[0]
    assert setup.models[0].at_end == LinkModel.follow_trace("loop").at_end
    assert setup.models[0].at_end != LinkModel.follow_trace("hold").at_end
    assert setup.traces[0] is not None
    assert setup.traces[0].tolist() == POINTS


def test_written_traces_replace_file_traces(tmp_path: Path) -> None:
    (tmp_path / "delays.csv").write_text("0,41.2\n", encoding="utf-8")
    file = 'file = "delays.csv"'
    loaded = make_trace_scenario(
        tmp_path, f'[link]\nmodel = "trace"\n{file}\n[links."m1->s"]\ntrace = "0 7"'
    )
    assert (loaded.links["m1->s"].trace, loaded.links["m2->s"].trace) == ("0 7", "0 41200")
    loaded = make_trace_scenario(
        tmp_path, f'[link]\nmodel = "trace"\ntrace = "0 7"\n[links."m1->s"]\n{file}'
    )
    assert (loaded.links["m1->s"].trace, loaded.links["m2->s"].trace) == ("0 41200", "0 7")
    loaded = make_trace_scenario(
        tmp_path, f'[link]\nmodel = "trace"\n{file}\n[links."m1->s"]\nat_end = "loop"'
    )
    assert (loaded.links["m1->s"].at_end, loaded.links["m2->s"].at_end) == ("loop", "hold")
