"""The export as a bag: in order of arrival, as long as the log, refused where the log is broken."""

from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.log_editing import edited, opened, recorded
from trilat_net.errors import LogError
from trilat_net.reporting.exports.ros2 import export_ros2


def test_messages_are_in_order_of_arrival(
    tmp_path: Path,
) -> None:
    path, told = tmp_path / "bag.mcap", list[int]()
    export_ros2(opened(recorded("paper")), path, told.append)
    with path.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages(log_time_order=False))
    times = [message.log_time for _, _, message in messages]
    assert times == sorted(times)
    topics = [channel.topic for _, channel, _ in messages]
    assert sum(topic.endswith("/joint_states") for topic in topics) == sum(told) == 3 * 120
    assert {"/m1/link_age", "/events", "/log"} <= set(topics)
    assert not {"/m1/link_delay", "/m1/link_offset", "/m1/timing"} & set(topics)


def test_records_that_came_late_stand_where_they_came(tmp_path: Path) -> None:
    """A gap in the log is a gap in the bag."""
    log = opened(edited(recorded("paper"), record=lambda r: None if 20 <= r["tick"] < 40 else r))
    path = tmp_path / "bag.mcap"
    export_ros2(log, path)
    with path.open("rb") as stream:
        states = [m for _, c, m in make_reader(stream).iter_messages("/m1/joint_states")]
    assert len(states) == 100


def test_a_record_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    log = opened(edited(recorded("paper"), record=lambda r: {**r, "q": r["q"][:1]} if r["tick"] == 7 else r))
    with pytest.raises(LogError, match="a record of m1 cannot be read"):
        export_ros2(log, tmp_path / "bag.mcap")
