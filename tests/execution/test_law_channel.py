"""Messages between laws reach their receivers, stand in the records, and are executed again."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tests.execution.builders import OTHER_PLATFORM
from tests.execution.deliveries import SITES, TICKS
from tests.log.builders import Record, edit_log_bytes, make_log_bytes, open_bytes
from trilat_net.errors import LogError
from trilat_net.execution import virtual
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log
from trilat_net.log.ros2.published import Ros2Topics
from trilat_net.log.view_rates import FULL_RATE_HZ
from trilat_net.presentation.rerun_viewer import PlotLayout
from trilat_net.scenario import load_scenario

LAW = "tests.channel_law:Talking"
DELAY_TICKS = 20
SHORT: dict[str, Any] = {"duration_s": 0.12, "link.delay_ms": 20.0, "control.law": LAW}


def make_talking_bytes(**more: Any) -> bytes:
    return make_log_bytes("paper", {**SHORT, **more})


def test_peers_get_own_and_common_vectors() -> None:
    """The energy that a site states, from the records of its peers alone, without the parts for others."""
    log = open_bytes(make_talking_bytes())
    alpha = log.scenario.dominance
    for site in SITES:
        energy = np.zeros(TICKS)
        for peer in log[site].peers:
            used = log[site].used[peer]
            assert used[-1] == TICKS - 1 - DELAY_TICKS
            heard = np.where(used[:, None] >= 0, log[peer].sent[f"target[{site}]"][used], 0.0)
            energy += (
                10.0 * alpha[site].get(peer, 0.0) * ((heard - log[site].q) ** 2).sum(axis=1)
            )
        assert log[site].sent["energy"][:, 0] == pytest.approx(energy, rel=1e-12)
        differences = [
            log[site].sent[f"target[{peer}]"] - log[site].q for peer in log[site].peers
        ]
        # the same for both joints
        assert all(np.ptp(difference, axis=1).max() < 1e-12 for difference in differences)
        assert np.abs(differences[0] - differences[1]).min() > 5e-3  # and other for each peer


@pytest.mark.parametrize("session", [None, OTHER_PLATFORM])
@pytest.mark.parametrize(
    ("place", "name"),
    [(0, "energy[0]"), (1, "target[m1][0]"), (2, "target[m1][1]"), (4, "target[s][1]")],
)
def test_a_changed_number_shows_at_its_own_tick(
    place: int, name: str, session: dict[str, str] | None
) -> None:
    def record(r: Record) -> Record:
        if (r["site"], r["tick"]) == ("m2", 40):
            r["ch"][place] += 1e-3
        return r

    first = verify_log(
        open_bytes(edit_log_bytes(make_talking_bytes(), record=record, session=session))
    ).first
    assert first is not None
    assert first[:3] == ("m2", 40, f"ch.{name}")


@pytest.mark.parametrize(("place", "differing"), [(0, 3), (1, 2), (3, 2)])
def test_arrival_sums_cover_exactly_the_received_numbers(place: int, differing: int) -> None:
    """A number that comes too late to be used shows at its arrival: at both peers, or at the one."""

    def record(r: Record) -> Record:
        if (r["site"], r["tick"]) == ("m2", TICKS - 2):
            r["ch"][place] += 1e-3
        return r

    assert (
        verify_log(open_bytes(edit_log_bytes(make_talking_bytes(), record=record))).differing
        == differing
    )


def test_records_with_wrong_law_messages_are_unreadable() -> None:
    def record(r: Record) -> Record:
        return {**r, "ch": r["ch"][:-1]}

    log = open_bytes(edit_log_bytes(make_talking_bytes(), record=record))
    with pytest.raises(LogError, match="ch has 4 numbers, not 5"):
        log["m1"].ch  # noqa: B018


def test_viewers_get_a_channel_per_vector(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    virtual.SimulatedLog.record_scenario(
        load_scenario("paper", SHORT), path, views_hz=FULL_RATE_HZ
    )
    channels = Ros2Topics.of_file(path)
    about = {
        topic.rpartition("/")[2]: channel_data.about
        for topic, channel_data in channels.items()
        if "/viz/m2/" in topic
    }
    sent = {
        name: entry_of_file["unit"]
        for name, entry_of_file in about.items()
        if name.startswith("sent_")
    }
    assert sent == {"sent_energy": "J", "sent_target_to_m1": "rad", "sent_target_to_s": "rad"}
    log = open_log(path)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        vectors = [
            [*message[3].data]
            for message in reader.iter_decoded_messages(topics=["/viz/m2/sent_target_to_s"])
        ]
    assert vectors == log["m2"].sent["target[s]"].tolist()
    page = PlotLayout.of_channels(channels).pages["Sent by laws"]
    assert [plot.title for plot in page[0]] == [
        f"{site}: energy that the law sends to all (J)" for site in SITES
    ]
    assert page[1][0].curves[0].names == ("target1", "target2")


def test_tables_name_messages_with_their_units() -> None:
    log = open_bytes(make_talking_bytes())
    table = log.table("m2", "state")
    columns = {
        column.source: column for column in table.columns if column.source.startswith("ch.")
    }
    assert {source: (data.name, data.unit) for source, data in columns.items()} == {
        "ch.energy[0]": ("ch_energy_j", "J"),
        "ch.target[m1][0]": ("ch_target_m1_1_rad", "rad"),
        "ch.target[m1][1]": ("ch_target_m1_2_rad", "rad"),
        "ch.target[s][0]": ("ch_target_s_1_rad", "rad"),
        "ch.target[s][1]": ("ch_target_s_2_rad", "rad"),
    }
    assert [*columns["ch.target[s][1]"].values] == [state.ch[4] for state in log["m2"].states]
