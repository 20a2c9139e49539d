"""Exports contain the log bit for bit, as other programs read them."""

import csv
import json
import struct
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import polars as pl
import pytest
import scipy.io
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tests.analysis.builders import make_busy_run
from tests.log.builders import make_log, rewrite_log
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import Event
from trilat_net.presentation.export import Exporter
from trilat_net.scenario import parse_scenario


@cache
def make_rich_log() -> Log:
    """Returns a log with all features: links of all kinds, modes, changes, events, statistics."""
    text = 'says "no",\nand 1.5 °C'
    awkward = Event(
        member="a", boot=2**64 - 1, kind="refused", text=text, t_ns=-1, clocks={"a": "x"}, n=0
    )
    plain = Event(
        member="c", boot=7, kind="end", text="c made 5 ticks", t_ns=9_000_000, ticks=5, n=0
    )
    stats = make_log("two_sites", {"duration_s": 0.4}).link_stats("m")
    new = {"site": "a", "dropped": {"not finite": 3}, "offset_us": {"b": -4}}
    statistics_list = [msgspec.structs.replace(statistics, **new) for statistics in stats]
    return rewrite_log(
        make_busy_run().log,
        lambda s: s.tick % 400 < 40,
        others=[awkward, plain, *statistics_list],
    )


@cache
def list_expected_values() -> dict[str, dict[str, list[Any]]]:
    """Returns the values of every column per table, as Python's own; None without a value."""
    wanted = {
        table.label: {column.name: column.rows(0, len(table)) for column in table.columns}
        for table in make_rich_log().tables()
    }
    assert len(wanted) == 3 * 3 + 1
    assert None in wanted["a_state"]["used_b_tick"]
    assert {"run", "hold", "return"} & set(wanted["a_state"]["mode"])
    assert any("\n" in text for text in wanted["events"]["text"])
    assert None in wanted["a_link"]["offset_c_us"]
    return wanted


def export_log(form: str, folder: Path) -> Path:
    path = folder / f"out-{form}"
    Exporter(form, path).export(make_rich_log())
    assert [entry.name for entry in folder.iterdir()] == [path.name]
    return path


def pack_float(value: float) -> bytes:
    return struct.pack("<d", value)


def is_same(value: Any, wanted: Any) -> bool:
    """True if two values are equal as numbers, and floats bit for bit."""
    if isinstance(wanted, float):
        return isinstance(value, float) and pack_float(value) == pack_float(wanted)
    return type(value) is type(wanted) and value == wanted


def test_csv_read_by_the_standard_library_and_polars(tmp_path: Path) -> None:
    folder = export_log("csv", tmp_path)
    for name, columns in list_expected_values().items():
        with (folder / f"{name}.csv").open(encoding="utf-8", newline="") as stream:
            heads, *rows = csv.reader(stream)
        assert heads == list(columns)
        for column_index, values in enumerate(columns.values()):
            for row, wanted in zip(rows, values, strict=True):
                text = row[column_index]
                read = (
                    text
                    if isinstance(wanted, str)
                    else None
                    if text == ""
                    else type(wanted)(text)
                )
                assert is_same(read, wanted)
    frame = pl.read_csv(folder / "b_state.csv")
    assert frame.columns == list(list_expected_values()["b_state"])
    for name, values in list_expected_values()["b_state"].items():
        assert all(map(is_same, frame[name].to_list(), values))


def test_parquet_read_by_polars(tmp_path: Path) -> None:
    folder = export_log("parquet", tmp_path)
    for name, columns in list_expected_values().items():
        frame = pl.read_parquet(folder / f"{name}.parquet")
        assert frame.columns == list(columns)
        for column, values in columns.items():
            assert all(map(is_same, frame[column].to_list(), values))


def test_npz_read_by_numpy(tmp_path: Path) -> None:
    arrays = np.load(export_log("npz", tmp_path))  # which refuses pickles
    seen_columns = set()
    for name, columns in list_expected_values().items():
        site, _, kind = name.partition("_")
        table_name = site if kind in ("", "state") else f"{site}/{kind}"
        for column, values in columns.items():
            seen_columns.add(f"{table_name}/{column}")
            read = arrays[f"{table_name}/{column}"].tolist()
            for value, wanted in zip(read, values, strict=True):
                if None in values:  # NaN needs a float
                    assert np.isnan(value) if wanted is None else value == wanted
                else:
                    assert is_same(value, wanted)
    assert set(arrays) == seen_columns | {"about_json", "scenario_toml"}
    assert parse_scenario(str(arrays["scenario_toml"])) == make_rich_log().scenario
    assert json.loads(str(arrays["about_json"]))["session"] == make_rich_log().session


def test_mat_read_by_scipy(tmp_path: Path) -> None:
    variables = scipy.io.loadmat(export_log("mat", tmp_path), simplify_cells=True)
    about = json.loads(variables["about_json"])
    assert about["tables"].keys() == {
        *(f"{site}{kind}" for site in "abc" for kind in ("", ".link", ".arrivals")),
        "events",
    }
    assert parse_scenario(variables["scenario_toml"]) == make_rich_log().scenario
    for name, columns in list_expected_values().items():
        site, _, kind = name.partition("_")
        struct_ = variables[site] if kind in ("", "state") else variables[site][kind]
        for column, values in columns.items():
            read = np.atleast_1d(struct_[column]).tolist()
            for value, wanted in zip(read, values, strict=True):
                if isinstance(wanted, str):
                    # an empty cell is an empty array
                    text = value if isinstance(value, str) else ""
                    assert text.rstrip() == wanted
                elif wanted is None:
                    assert np.isnan(value)
                else:
                    assert value == wanted
                    assert pack_float(float(value)) == pack_float(float(wanted))
            said = about["tables"][site if kind in ("", "state") else f"{site}.{kind}"][
                "columns"
            ][column]
            units = struct_["units"][column]
            assert (units if isinstance(units, str) else "") == said["unit"]


def test_live_stamps_are_exact_in_matlab(tmp_path: Path) -> None:
    """1.7e18 ns are no exact double."""
    sites = scipy.io.loadmat(export_log("mat", tmp_path), simplify_cells=True)
    assert sites["a"]["publish_time_ns"].dtype == np.int64
    assert (
        sites["a"]["publish_time_ns"].tolist() == make_rich_log()["a"].publish_time_ns.tolist()
    )
    assert sites["a"]["tick"].dtype == np.float64


def test_ros2_read_by_mcap_ros2(tmp_path: Path) -> None:
    path = export_log("ros2", tmp_path)
    wanted = list_expected_values()
    columns: dict[str, list[list[float]]] = {}
    with path.open("rb") as stream:
        for _, channel, message, decoded in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages(
            topics=[
                f"/{make_rich_log().session['session']}/{site}/joint_states" for site in "abc"
            ]
        ):
            row = [*decoded.position, *decoded.velocity, *decoded.effort, message.publish_time]
            columns.setdefault(channel.topic.split("/")[2], []).append(row)
    names = (
        "q1_rad",
        "q2_rad",
        "qd1_rad_s",
        "qd2_rad_s",
        "tau1_nm",
        "tau2_nm",
        "publish_time_ns",
    )
    for site in "abc":
        rows = zip(*(wanted[f"{site}_state"][name] for name in names), strict=True)
        assert columns[site] == [list(row) for row in rows]


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_a_folder_describes_its_files(form: str, tmp_path: Path) -> None:
    folder = export_log(form, tmp_path)
    about = json.loads((folder / "about.json").read_text())
    assert set(about["tables"]) == {path.name for path in folder.iterdir()} - {
        "about.json",
        "scenario.toml",
    }
    assert about["session"] == make_rich_log().session
    assert about["complete"] is True
    state = about["tables"][f"a_state.{form}"]
    assert state["rows"] == len(make_rich_log()["a"])
    assert state["columns"]["q1_rad"] == {
        "unit": "rad",
        "meaning": "joint angles, joint 1",
        "source": "q[0]",
    }
    assert (folder / "scenario.toml").read_bytes().decode() == make_rich_log().scenario_text


@pytest.mark.parametrize("form", ["ros2", "csv", "parquet", "npz", "mat"])
def test_exports_have_no_stamp_of_their_own(form: str, tmp_path: Path) -> None:
    """The same log gives the same bytes, except in formats that stamp their files."""
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        export_log(form, tmp_path / name)
    first, two = (
        {p.name: p.read_bytes() for p in (tmp_path / n).rglob("*") if p.is_file()}
        for n in ("one", "two")
    )
    if form == "mat":  # its first 116 bytes are a text with the date
        first, two = (
            {name: data[128:] for name, data in files.items()} for files in (first, two)
        )
    assert first == two
