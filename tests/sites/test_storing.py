"""The content of the file during a session, and after a full disk; the parts of a session are
the session.
"""

from collections import Counter
from pathlib import Path

import pytest

from tests.log.disks import SmallDisk, open_file_on
from tests.net.waiting import sleep_for_ns
from tests.sites.sessions import pack_computed
from trilat_net.errors import LogRefused
from trilat_net.execution.verification import verify_log
from trilat_net.log import log_writer
from trilat_net.log.log_layout import ChannelFilter, active_path
from trilat_net.log.log_reader import open_log
from trilat_net.log.log_writer import LogStorage
from trilat_net.log.mcap_reader import McapReader
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import SESSION, Session

MS = 1_000_000
SITES = ("m", "s")


def make_session(folder: Path, duration_s: float, storage: LogStorage | None = None) -> Session:
    return Session.whole(
        load_scenario("two_sites", {"duration_s": duration_s}), folder, storage=storage
    )


def count_records(path: Path) -> dict[str, int]:
    with path.open("rb") as stream:
        return Counter(item.topic for item in McapReader(stream, str(path)).messages())


def test_records_100_ms_before_a_crash_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    session = make_session(tmp_path, 0.4)
    looks: list[tuple[int, int]] = []

    def look(_: Bus, clock: RelayClock) -> None:
        while not path.exists():
            sleep_for_ns(clock, 19 * MS)
            if not active_path(path).exists():
                continue
            with active_path(path).open("rb") as stream:
                walk = McapReader(stream, "look")
                count = Counter(item.topic for item in walk.messages())
            epoch_ns = int(walk.metadata["trilat.session"]["epoch_unix_ns"])
            due = min(400, (clock.unix_ns() - 100 * MS - epoch_ns) // MS)
            looks.extend((count[f"/trilat/{SESSION}/{site}/state"], due) for site in SITES)

    session.stranger(look)
    session.run()
    assert len(looks) > 40
    assert max(due for _, due in looks) > 200
    assert all(have >= due for have, due in looks)


@pytest.mark.parametrize("room", range(160_000, 300_000, 45_000))
def test_on_a_full_disk_accounts_match_the_file(
    room: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    monkeypatch.setattr(
        log_writer, "LogFile", lambda path, **_: open_file_on(SmallDisk(room), path)
    )
    session = make_session(tmp_path, 2.0)
    with pytest.raises(
        LogRefused, match="the disk is full; the log ends there, finished"
    ) as refusal:
        session.run()
    assert refusal.value.exit_code == 5
    log = open_log(path)
    assert log.complete
    verdict = verify_log(log)
    assert verdict.agreed
    assert verdict.integrity.passed
    assert not verdict.passed  # no site could say how it ended
    stored = count_records(path)
    for name in SITES:
        assert [state.tick for state in log[name].states] == list(range(len(log[name])))
        for channel in (topics.STATE, topics.LINK, topics.EVENT):
            topic = "/" + topics.key(SESSION, name, channel)
            assert f"received {stored[topic]}, missing 0" in log.accounts[topic]
    assert session.relay.results == dict.fromkeys(SITES, 0)  # the sites went on


def test_a_session_in_parts_is_the_session(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    whole = make_session(tmp_path / "whole", 0.5).run()
    path = tmp_path / "run.mcap"
    session = make_session(tmp_path, 0.5, LogStorage(path, split_ns=125 * MS))
    with pytest.raises(Exception, match="No such file"):
        session.run()  # there is no file of that name
    names = [part.name for part in sorted(LogStorage(path).find_parts().values())]
    assert names == [f"run-00{n}.mcap" for n in range(1, len(names) + 1)]
    assert len(names) >= 4
    log = open_log(*(tmp_path / name for name in names))
    for site in SITES:
        assert [pack_computed(state) for state in log[site].states] == [
            pack_computed(state) for state in whole[site].states
        ]
    tick_count = 0
    for name in names:
        part = open_log(tmp_path / name)
        tick_count += len(part["m"])
        said = part.accounts[f"/trilat/{SESSION}/m/state"]
        # the message that begins the next part has come when this one ends
        assert any(
            f"received {known}, missing 0" in said for known in (tick_count, tick_count + 1)
        )


def test_excluded_channels_are_neither_stored_nor_missing(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    choice = ChannelFilter(("**/m/**", "**/s/event"), ("**/link",))
    log = make_session(tmp_path, 0.3, LogStorage(path, choice=choice)).run()
    assert len(log["m"]) == 300
    assert len(log["s"]) == 0
    kept = {f"/trilat/{SESSION}/{what}" for what in ("m/state", "m/event", "s/event")}
    assert (
        set(count_records(path))
        == kept
        == {name for name in log.accounts if name.startswith("/")}
    )
    assert (log.session["include"], log.session["exclude"]) == ("**/m/** **/s/event", "**/link")
