"""Exports of sites that follow with their end effectors, as other programs read them.

The export as a bag: in order of arrival, as long as the log, refused if the log is broken.
"""

import csv
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import scipy.io
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

import trilat_net
from tests.log.builders import edit_log_bytes, make_log, make_log_bytes, open_bytes
from tests.programs import RERUN, list_rerun_faults, run_program
from tests.scenario.builders import planar_task_text
from trilat_net.errors import LogError
from trilat_net.execution.virtual import write_virtual_log
from trilat_net.log.log_reader import Log
from trilat_net.log.ros2.published import Ros2Topics
from trilat_net.presentation.export import Exporter
from trilat_net.presentation.rerun_viewer import ViewerOptions, open_rerun
from trilat_net.scenario import parse_scenario

HEADS = {
    "q_des": ("q_des_x_m", "q_des_y_m", "q_des_z_m"),
    "qd_des": ("qd_des_x_m_s", "qd_des_y_m_s", "qd_des_z_m_s"),
    "x": ("x_x_m", "x_y_m", "x_z_m"),
    "xd": ("xd_x_m_s", "xd_y_m_s", "xd_z_m_s"),
    "wrench": ("wrench_x_n", "wrench_y_n", "wrench_z_n"),
}


@cache
def make_task_log() -> Log:
    hands = '[[sites.s.hands]]\nkind = "tip_spring"\nto_m = [1.0, 1.0, 0.0]\nstiffness_n_m = 50\n[dominance]'
    return trilat_net.simulate(
        parse_scenario(planar_task_text(0.2).replace("[dominance]", hands))
    )


def export_log(form: str, folder: Path) -> Path:
    path = folder / ("out.mcap" if form == "ros2" else f"out.{form}")
    Exporter(form, path).export(make_task_log())
    return path


def test_csv_read_by_the_standard_library_and_polars(tmp_path: Path) -> None:
    folder = export_log("csv", tmp_path)
    with (folder / "s_state.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    frame = pl.read_csv(folder / "s_state.csv")
    for field, heads in HEADS.items():
        wanted = getattr(make_task_log()["s"], field)
        assert np.array_equal([[float(row[head]) for head in heads] for row in rows], wanted)
        assert np.array_equal(frame.select(heads).to_numpy(), wanted)
    assert np.abs(make_task_log()["s"].wrench).max() > 1.0
    columns = json.loads((folder / "about.json").read_text())["tables"]["s_state.csv"][
        "columns"
    ]
    assert columns["wrench_x_n"]["unit"] == "N"
    assert columns["x_z_m"]["source"] == "x[2]"
    assert "q_des1_rad" not in columns


def test_mat_read_by_scipy_and_frames_by_polars(tmp_path: Path) -> None:
    site = scipy.io.loadmat(export_log("mat", tmp_path), simplify_cells=True)["m"]
    (table,) = (
        table_of_site
        for table_of_site in make_task_log().tables()
        if table_of_site.label == "m_state"
    )
    frame = table.to_data_frame()
    for field, heads in HEADS.items():
        wanted = getattr(make_task_log()["m"], field)
        assert np.array_equal(np.stack([site[head] for head in heads], axis=1), wanted)
        assert np.array_equal(frame.select(heads).to_numpy(), wanted)


def list_numbers(message: Any) -> list[float]:
    """Returns the place, velocity or force of a stamped message."""
    if hasattr(message, "pose"):
        vector = message.pose.position
    else:
        vector = message.twist.linear if hasattr(message, "twist") else message.wrench.force
    return [vector.x, vector.y, vector.z]


def test_ros2_read_by_rosbags(tmp_path: Path) -> None:
    path = export_log("ros2", tmp_path)
    columns: dict[str, list[list[float]]] = {}
    with AnyReader([path]) as bag:
        for connection, _, data in bag.messages():
            if connection.topic.startswith("/planar/s/") and connection.msgtype.endswith(
                "Float64MultiArray"
            ):
                message = bag.deserialize(data, connection.msgtype)
                columns.setdefault(connection.topic, []).append(message.data.tolist())
            if (
                connection.topic.startswith("/planar/s/")
                and "geometry_msgs" in connection.msgtype
            ):
                message = bag.deserialize(data, connection.msgtype)
                columns.setdefault(connection.topic, []).append(list_numbers(message))
        types = {connection.topic: connection.msgtype for connection in bag.connections}
    part = make_task_log()["s"]
    for topic, vectors in {
        "reference_pose": part.q_des,
        "reference_twist": part.qd_des,
        "tip_pose": part.x,
        "tip_twist": part.xd,
        "tip_wrench": -part.wrench,
        "error": part.e,
    }.items():
        assert np.array_equal([row[:3] for row in columns[f"/planar/s/{topic}"]], vectors)
    assert types["/planar/s/joint_states"] == "sensor_msgs/msg/JointState"
    assert types["/planar/s/robot_description"] == "std_msgs/msg/String"
    assert types["/tf"] == "tf2_msgs/msg/TFMessage"


@pytest.mark.long
def test_rerun_reads_a_log_and_its_bag(tmp_path: Path) -> None:
    source = tmp_path / "run.mcap"
    saved = tmp_path / "run.rrd"
    with source.open("wb") as stream:
        write_virtual_log(make_task_log().scenario, stream)
    assert list_rerun_faults(source) == []
    assert list_rerun_faults(export_log("ros2", tmp_path)) == []
    open_rerun([source], make_task_log, ViewerOptions(save=saved), lambda _: None)
    text = run_program(*RERUN, "rrd", "print", "-vvv", str(saved))
    assert [name for name in Ros2Topics.of_file(source) if name not in text] == []


def test_messages_are_in_order_of_arrival(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bag.mcap"
    progress = list[tuple[int, int]]()
    Exporter("ros2", path).export(
        make_log("paper"), progress=lambda *counts: progress.append(counts)
    )
    with path.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages(log_time_order=False))
    times = [message.log_time for _, _, message in messages]
    assert times == sorted(times)
    topics = [channel.topic for _, channel, _ in messages]
    assert sum(topic.endswith("/joint_states") for topic in topics) == 3 * 120
    assert progress[-1] == (3 * 120, 3 * 120)
    assert {"/paper/m1/link_age", "/paper/events", "/paper/log", "/tf", "/diagnostics"} <= set(
        topics
    )
    assert not {f"/paper/m1/{name}" for name in ("link_delay", "link_offset", "timing")} & set(
        topics
    )


def test_late_records_stand_where_they_came(tmp_path: Path) -> None:
    """A gap in the log is a gap in the bag."""
    log = open_bytes(
        edit_log_bytes(
            make_log_bytes("paper"), record=lambda r: None if 20 <= r["tick"] < 40 else r
        )
    )
    path = tmp_path / "bag.mcap"
    Exporter("ros2", path).export(log)
    with path.open("rb") as stream:
        states = [m for _, c, m in make_reader(stream).iter_messages("/paper/m1/joint_states")]
    assert len(states) == 100


def test_unreadable_records_are_reported(tmp_path: Path) -> None:
    log = open_bytes(
        edit_log_bytes(
            make_log_bytes("paper"),
            record=lambda r: {**r, "q": r["q"][:1]} if r["tick"] == 7 else r,
        )
    )
    with pytest.raises(LogError, match="a record of m1 cannot be read"):
        Exporter("ros2", tmp_path / "bag.mcap").export(log)
