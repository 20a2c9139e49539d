"""The file: readable by the plain `mcap` package, the same twice, and honest where it is torn (L5)."""

import hashlib
import io
import json
from pathlib import Path

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from tests.log.builders import edit_log_bytes, make_log_bytes, open_bytes
from tests.log.split_logs import make_foreign_bytes
from trilat_net.core.step.fingerprint import compute_fingerprint
from trilat_net.errors import LogError
from trilat_net.execution import virtual
from trilat_net.log.log_reader import open_log
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.message_identity import compute_virtual_boot
from trilat_net.log.provenance import collect_provenance
from trilat_net.net.wire import encode_state
from trilat_net.scenario import list_shipped, load_scenario

TICKS = 120


@pytest.mark.parametrize("name", list_shipped())
def test_equal_virtual_runs_are_the_same_file(name: str) -> None:
    digests = set()
    for _ in range(2):
        stream = io.BytesIO()
        virtual.write_virtual_log(
            load_scenario(name, {"duration_s": 0.3}), stream, views_hz=100.0
        )
        digests.add(hashlib.sha256(stream.getvalue()).hexdigest())
    assert len(digests) == 1


def test_another_seed_is_another_file() -> None:
    assert make_log_bytes("paper", {"duration_s": 0.05}) != make_log_bytes(
        "paper", {"duration_s": 0.05, "seed": 2}
    )


def test_virtual_logs_have_no_path_or_clock() -> None:
    data = edit_log_bytes(make_log_bytes("paper"))
    assert str(Path(__file__).parents[2]).encode() not in data
    for _, _, message in make_reader(io.BytesIO(make_log_bytes("paper"))).iter_messages():
        assert message.log_time == message.publish_time < 10**9


def test_plain_readers_find_every_payload_byte() -> None:
    scenario = load_scenario("paper", {"duration_s": 0.12, "link.delay_ms": 20.0})
    sent = {
        (site.name, output.tick): encode_state(
            site.name,
            compute_virtual_boot(scenario.sha256, site.name),
            site.peers,
            output,
            arrivals,
            0,
            0,
        )
        for site, arrivals, output in virtual.execute_virtual(scenario)
    }
    reader = make_reader(io.BytesIO(make_log_bytes("paper")), validate_crcs=True)
    found = 0
    for schema, channel, message in reader.iter_messages():
        assert schema is not None
        assert schema.id != 0
        assert schema.encoding == "jsonschema"
        assert json.loads(schema.data)["type"] == "object"
        assert channel.message_encoding == "msgpack"
        root, session, member, kind = channel.topic.removeprefix("/").split("/")
        assert (root, session) == ("trilat", "paper")
        if kind == "state":
            found += 1
            assert message.data == sent[member, message.sequence]
            assert message.publish_time == message.sequence * 1_000_000
            assert channel.metadata == {"member": member, "rate_hz": "1000"}
    assert found == len(sent) == 3 * TICKS


def required_and_typed(schema: dict, value: object) -> None:
    """Checks a value against the parts of JSON Schema that our schemas use."""
    kinds = {
        "object": dict,
        "array": list,
        "string": str,
        "integer": int,
        "number": (int, float),
    }
    assert isinstance(value, kinds[schema["type"]])
    if isinstance(value, dict):
        assert set(schema.get("required", [])) <= set(value)
        for key, entry in value.items():
            assert (
                key in schema.get("properties", {})
                or schema["additionalProperties"] is not False
            )
            extra = schema.get("additionalProperties")
            inner = schema.get("properties", {}).get(key, extra)
            if isinstance(inner, dict) and "type" in inner:
                required_and_typed(inner, entry)
    if isinstance(value, list):
        assert schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", 10**6)
        for entry in value:
            required_and_typed(schema["items"], entry)


def test_every_message_is_one_that_its_schema_allows() -> None:
    kinds = set()
    for schema, channel, message in make_reader(
        io.BytesIO(make_log_bytes("paper"))
    ).iter_messages():
        assert schema is not None
        required_and_typed(json.loads(schema.data), msgpack.unpackb(message.data))
        kinds.add(channel.topic.rpartition("/")[2])
    assert kinds == {"state", "link", "event"}


def test_files_hold_session_scenario_and_accounts() -> None:
    reader = make_reader(io.BytesIO(make_log_bytes("paper")))
    metadata = {entry.name: entry.metadata for entry in reader.iter_metadata()}
    session = metadata["trilat.session"]
    scenario = load_scenario("paper", {"duration_s": 0.12, "link.delay_ms": 20.0})
    assert session["driver"] == "virtual"
    assert session["epoch_unix_ns"] == "0"
    assert session["scenario_sha256"] == scenario.sha256
    assert session["seed"] == "1"
    assert session["fingerprint"] == compute_fingerprint()
    assert {"commit", "python", "platform", "version_numpy", "version_trilat-net"} <= set(
        session
    )
    (attachment,) = reader.iter_attachments()
    assert (attachment.name, attachment.data.decode()) == ("scenario.toml", scenario.text)
    for site in scenario.names:
        text = metadata["trilat.accounts"][f"/trilat/paper/{site}/state"]
        assert text.startswith(
            "expected 120, received 120, missing 0, duplicate 0, reordered 0, refilled 0, "
        )
        text = metadata["trilat.accounts"][f"/trilat/paper/{site}/link"]
        assert text.startswith(
            "expected 2, received 2, missing 0, duplicate 0, reordered 0, refilled 0, "
        )


def test_session_and_scenario_precede_the_first_message() -> None:
    """So that they survive a crash right after the start."""
    stream = io.BytesIO()
    LogWriter(stream, load_scenario("free"), "lab", "live", 10**18, collect_provenance())
    log = open_bytes(stream.getvalue())
    assert log.scenario == load_scenario("free")
    assert (log.driver, log.complete, log.accounts) == ("live", False, {})
    assert len(log["m1"]) == 0


def test_a_live_log_counts_from_its_epoch() -> None:
    stream = io.BytesIO()
    writer = LogWriter(
        stream,
        load_scenario("free"),
        "lab",
        "live",
        10**18,
        collect_provenance(),
        {"mood": "calm"},
    )
    for k in (0, 2):
        writer.add("trilat/lab/m1/state", b"\x80", k * 1_000_000, 10**18 + 5, k)
    writer.finish({"dropped": "1"})
    reader = make_reader(io.BytesIO(stream.getvalue()))
    assert [m.publish_time - 10**18 for _, _, m in reader.iter_messages()] == [0, 2_000_000]
    metadata = {entry.name: entry.metadata for entry in reader.iter_metadata()}
    assert metadata["trilat.session"]["mood"] == "calm"
    assert metadata["trilat.accounts"] == {"dropped": "1"}


def test_the_reader_gives_arrays_with_time() -> None:
    log = open_bytes(make_log_bytes("paper"))
    assert log.sites == ("m1", "m2", "s")
    assert log.complete
    m1 = log["m1"]
    assert (m1.tick == np.arange(TICKS)).all()
    assert np.allclose(m1.t_s, np.arange(TICKS) * 1e-3)
    assert (m1.q.shape, m1.theta_hat.shape, m1.busy_us.shape) == (
        (TICKS, 2),
        (TICKS, 5),
        (TICKS - 1,),
    )
    assert (m1.e == m1.q - m1.q_des).all()
    assert (m1.used["s"] == np.maximum(np.arange(TICKS) - 20, -1)).all()
    age = m1.age_s("s", 1000)
    assert np.isnan(age[:20]).all()
    assert age[20:] == pytest.approx(0.02)
    assert [event.kind for event in log.events] == ["end"] * 3
    assert [stats.tick for stats in log.link_stats("m1")][:1] != []
    with pytest.raises(KeyError, match="m1, m2, s"):
        log["stranger"]


# What is torn, damaged, or not ours.


def test_cut_files_open_as_far_as_whole() -> None:
    """It says that it is not complete, or is refused; nothing else comes out."""
    data = edit_log_bytes(make_log_bytes("paper"), chunk_bytes=4096)
    before = 0
    for end in range(0, len(data), len(data) // 60):
        try:
            log = open_bytes(data[:end])
            records = len(log["m1"].states)
        except LogError:
            continue
        assert not log.complete
        assert records >= before
        before = records
    assert before == TICKS
    assert open_bytes(data).complete


def test_an_mcap_file_of_others_is_refused() -> None:
    with pytest.raises(LogError, match=r"not a log of trilat-net"):
        open_bytes(make_foreign_bytes())


def test_mcap_files_using_our_names_are_refused() -> None:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    writer.add_metadata("trilat.session", {})
    writer.add_attachment(
        0, 0, "scenario.toml", "application/toml", load_scenario("free").text.encode()
    )
    writer.finish()
    with pytest.raises(LogError):
        len(open_bytes(stream.getvalue())["m1"])


def test_unreadable_events_are_omitted() -> None:
    """One odd channel does not make a whole log unreadable; it is said, and the log is not complete."""
    whole = open_bytes(make_log_bytes("paper"))
    odd = open_bytes(
        edit_log_bytes(
            make_log_bytes("paper"),
            event=lambda payload: b"\xc1" if b"m1" in payload else payload,
        )
    )
    assert np.array_equal(odd["m1"].q, whole["m1"].q)
    assert [event.member for event in odd.events] == [
        e.member for e in whole.events if e.member != "m1"
    ]
    assert len(odd.timed_events().messages) == len(odd.events)
    assert not odd.complete
    assert whole.unreadable == []
    assert len(odd.unreadable) == 1
    assert "/m1/event cannot be read" in odd.unreadable[0]


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.mcap"):
        with pytest.raises(LogError, match="cannot be read"):
            open_log(path)


def test_logs_with_empty_scenarios_are_refused() -> None:
    with pytest.raises(LogError, match="scenario"):
        open_bytes(edit_log_bytes(make_log_bytes("paper"), scenario=lambda _: ""))
