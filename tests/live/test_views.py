"""The standard channels of a log that a recorder wrote, in the hands of other people's programs."""

from collections import defaultdict

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from tests.cli.running import trilat
from tests.live.processes import open_whole_log
from tests.programs import list_rerun_faults

from .processes import Session, Stage

BUCKET_NS = 20_000_000


@pytest.mark.long
def test_a_recorded_session_is_read_by_everybody(stage: Stage) -> None:
    """The views have the extremes of the records, and the bag has all records."""
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "1.5")
    session.all()
    session.ends_well()
    log = open_whole_log(session.log)
    shown: dict[tuple[str, int], list[list[float]]] = defaultdict(list)
    epoch_ns = int(log.session["epoch_unix_ns"])
    with session.log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for site in log.sites:
            for _, _, message, ros in reader.iter_decoded_messages(f"/viz/{site}/joint_states"):
                bucket = (message.publish_time - epoch_ns) // BUCKET_NS
                shown[site, bucket].append([*ros.position, *ros.velocity[:2], *ros.effort[:2]])
    for site in log.sites:
        part = log[site]
        rows = np.hstack([part.q, part.q_des, part.qd, part.tau])
        for bucket in range(len(part) // 20):
            ticks = rows[20 * bucket : 20 * bucket + 20]
            got = np.array(shown[site, bucket])
            assert np.array_equal(got.min(axis=0), ticks.min(axis=0))
            assert np.array_equal(got.max(axis=0), ticks.max(axis=0))
    bag = stage.folder / "bag.mcap"
    trilat("log", "export", session.log, "--to", "ros2", "-o", bag, cwd=stage.folder).succeeds()
    with AnyReader([bag]) as opened:
        counts = {connection.topic: connection.msgcount for connection in opened.connections}
    assert all(
        counts[f"/{log.session['session']}/{site}/joint_states"] == len(log[site])
        for site in log.sites
    )
    assert list_rerun_faults(session.log) == []
