"""A dataset of LeRobot contains the log at the times of its frames, as other programs read it."""

import json
from fractions import Fraction
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import trilat_net
from tests.analysis.builders import make_busy_run
from tests.log.builders import rewrite_log
from tests.scenario.builders import planar_task_text, posed_task_text
from trilat_net.errors import LogError, UsageError
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import Event, State
from trilat_net.presentation.export import Exporter
from trilat_net.scenario import parse_scenario

FILE = "chunk-000/file-000.parquet"
USERS = {
    "action": 2,
    "action.a": 2,
    "action.b": 2,
    "tau_x": 2,
    "tau_x.a": 2,
    "tau_x.b": 2,
    "dominance": 2,
    "age_s": 2,
}
AGES = ("age_s.a", "age_s.b")
PLACES = {"frame_index", "episode_index", "index", "task_index"}


def make_users_log() -> Log:
    """Returns a log of users a and b, of which b has 150 Hz, and a slave c; from 4 to 5 s its
    shares change to 0.9 and 0.1.
    """
    return make_busy_run().log


@cache
def make_users_log_without(*missing: tuple[float, float]) -> Log:
    """Returns the log without the slave's records of some times, s."""

    def keep(state: State) -> bool:
        return state.site != "c" or not any(a <= state.t_ns * 1e-9 < b for a, b in missing)

    return rewrite_log(make_users_log(), keep)


def export_logs(folder: Path, *sources: Log, **settings: Any) -> Path:
    Exporter("lerobot", folder / "set", settings=settings).export(*sources)
    return folder / "set"


def read_frames(folder: Path, place: str = "data") -> pl.DataFrame:
    return pl.read_parquet(folder / place / FILE)


def read_info(folder: Path, name: str = "meta/info") -> dict[str, Any]:
    facts: dict[str, Any] = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    return facts


def make_event(text: str, at_s: float, kind: str = "mark") -> Event:
    return Event(member="a", boot=1, kind=kind, text=text, t_ns=round(at_s * 1e9))


def read_newest(source: Log, site: str, field: str, count: int, fps: int) -> np.ndarray:
    """Returns a vector of the newest records at or before the times of frames, by exact fractions."""
    part = source[site]
    ticks = [int(Fraction(n, fps) * part.rate_hz) for n in range(count)]
    return np.array([getattr(part.by_tick[tick], field) for tick in ticks], dtype=np.float32)


def test_columns_are_those_of_the_format(tmp_path: Path) -> None:
    folder = export_logs(tmp_path, make_users_log())
    info_text = read_info(folder)
    assert {
        key: info_text[key] for key in ("codebase_version", "fps", "video_path", "splits")
    } == {
        "codebase_version": "v3.0",
        "fps": 30,
        "video_path": None,
        "splits": {"train": "0:1"},
    }
    assert info_text["data_path"].format(chunk_index=0, file_index=0) == f"data/{FILE}"
    schema = pq.read_schema(folder / "data" / FILE)
    wanted = {name: pa.list_(pa.float32(), size) for name, size in USERS.items()}
    wanted |= {"observation.state": pa.list_(pa.float32(), 4), "timestamp": pa.float32()}
    wanted |= dict.fromkeys(AGES, pa.float32())
    wanted |= {"next.done": pa.bool_(), **dict.fromkeys(PLACES, pa.int64())}
    assert {field.name: field.type for field in schema} == wanted
    assert set(info_text["features"]) == set(wanted)
    assert info_text["features"]["observation.state"] == {
        "dtype": "float32",
        "shape": [4],
        "names": ["c.q1.pos", "c.q2.pos", "c.q1.vel", "c.q2.vel"],
    }
    assert info_text["features"]["dominance"]["names"] == ["a", "b"]
    assert info_text["features"]["age_s"]["names"] == ["a", "b"]
    assert info_text["features"]["age_s.b"]["names"] == ["c"]
    assert info_text["features"]["next.done"] == {"dtype": "bool", "shape": [1], "names": None}


@pytest.mark.parametrize("fps", [30, 7])
def test_frames_have_the_newest_earlier_records(fps: int, tmp_path: Path) -> None:
    """The last ticks of the run of 6 s are at 5.995 s, and at 5.9933 s for b."""
    frames = read_frames(export_logs(tmp_path, make_users_log(), fps=fps))
    assert len(frames) == 6 * fps
    for column, site, field in (
        ("action.b", "b", "q"),
        ("action.a", "a", "q"),
        ("tau_x", "c", "tau_x"),
    ):
        assert np.array_equal(
            frames[column].to_numpy(), read_newest(make_users_log(), site, field, 6 * fps, fps)
        )
    state = np.hstack(
        [read_newest(make_users_log(), "c", field, 6 * fps, fps) for field in ("q", "qd")]
    )
    assert np.array_equal(frames["observation.state"].to_numpy(), state)
    assert state.sum() == frames["observation.state"].to_numpy().sum() != 0.0
    assert frames["timestamp"].to_list() == pytest.approx([n / fps for n in range(6 * fps)])
    assert frames["index"].to_list() == frames["frame_index"].to_list() == list(range(6 * fps))


def test_sample_ages_follow_the_drawn_delay(tmp_path: Path) -> None:
    """The age of a sample is the delay of its link, up to a tick, and grows until the first one."""
    delays_ms = (60.0, 240.0)
    runs = [
        trilat_net.simulate("paper", {"link.delay_ms": delay_ms}, duration_s=0.6)
        for delay_ms in delays_ms
    ]
    folder = export_logs(tmp_path, *runs)
    frames = read_frames(folder)
    tick_s = 1e-3
    for episode, delay_ms in enumerate(delays_ms):
        rows = frames.filter(pl.col("episode_index") == episode)
        times_s = rows["timestamp"].to_numpy()
        delay_s = 1e-3 * delay_ms
        for key in ("age_s.m1", "age_s.m2"):
            assert np.allclose(
                rows[key].to_numpy(), np.minimum(times_s, delay_s), atol=1.5 * tick_s
            ), key
        both = rows["age_s"].to_numpy()
        assert np.allclose(both.T, np.minimum(times_s, delay_s), atol=1.5 * tick_s)
    stats = read_info(folder, "meta/stats")
    assert stats["age_s"]["max"] == pytest.approx([0.24, 0.24], abs=tick_s)
    assert np.isfinite(stats["age_s.m2"]["mean"]).all()


def test_users_above_the_programs_share_intervene(tmp_path: Path) -> None:
    """The program is b: a leads from 4 s on, and is at 0.7 half-way through the ramp."""
    frames = read_frames(export_logs(tmp_path, make_users_log(), program="b"))
    shares = frames["dominance"].to_numpy()
    assert shares[120].tolist() == [0.5, 0.5]
    assert shares[135] == pytest.approx([0.7, 0.3])
    assert shares[-1] == pytest.approx([0.9, 0.1])
    assert frames["intervention"].to_list() == [n > 120 for n in range(180)]
    leader = np.where(
        frames["intervention"].to_numpy()[:, None], frames["action.a"], frames["action.b"]
    )
    assert np.array_equal(frames["action"].to_numpy(), leader)


def test_a_named_program_replaces_the_default(tmp_path: Path) -> None:
    frames = read_frames(export_logs(tmp_path, make_users_log(), program="a"))
    assert not frames["intervention"].any()
    assert np.array_equal(frames["action"].to_numpy(), frames["action.a"].to_numpy())
    with pytest.raises(UsageError, match="the program can hold the arm of a or b, not of 'c'"):
        Exporter("lerobot", tmp_path / "other", settings={"program": "c"}).export(
            make_users_log()
        )


def test_without_a_program_nobody_intervenes(tmp_path: Path) -> None:
    """At equal shares the first user leads, and no column says that a person corrected b."""
    for name, settings in (("found", {}), ("named", {"program": "none"})):
        (tmp_path / name).mkdir()
        folder = export_logs(tmp_path / name, make_users_log(), **settings)
        frames = read_frames(folder)
        assert "intervention" not in frames.columns
        assert np.array_equal(frames["action"].to_numpy(), frames["action.a"].to_numpy())
        assert read_info(folder, "about")["program"] == "none"


def test_a_policy_that_took_hold_is_the_program(tmp_path: Path) -> None:
    """Among others that held arms; a log without a policy has no intervention."""
    taken = [make_event("a: live page takes hold at t = 1.000 s", 1.0, "hand")]
    taken += [make_event("b: policy takes hold at t = 2.000 s", 2.0, "hand")]
    held = rewrite_log(make_users_log(), others=taken)
    folder = export_logs(tmp_path, held, make_users_log())
    assert read_info(folder, "about")["program"] == "b and none"
    assert [each["program"] for each in read_info(folder, "about")["sessions"]] == ["b", "none"]
    frames = read_frames(folder)
    assert frames["intervention"].to_list() == [n > 120 for n in range(180)] + 180 * [False]


def test_marks_divide_a_log_into_episodes(tmp_path: Path) -> None:
    """1 to 2 s succeed, 3 to 4 s fail, and the end interrupts the episode that begins at 5 s."""
    marks = [
        make_event(f"episode {text}", at_s)
        for text, at_s in (
            ("one begins", 1.0),
            ("one succeeded", 2.0),
            ("two begins", 3.0),
            ("two failed", 4.0),
            ("three begins", 5.0),
        )
    ]
    source = rewrite_log(make_users_log(), others=[make_event("look", 0.5), *reversed(marks)])
    folder = export_logs(tmp_path, source, episodes="marks", task="stack the cups")
    frames = read_frames(folder)
    assert read_frames(folder, "meta/episodes")["length"].to_list() == [30, 30, 30]
    ends = frames.filter(pl.col("next.done"))
    assert ends["index"].to_list() == [29, 59, 89]
    assert ends["next.success"].to_list() == [True, False, False]
    assert frames["next.success"].sum() == 1
    whole = read_newest(make_users_log(), "b", "q", 180, 30)
    marked = np.vstack([whole[30:60], whole[90:120], whole[150:]])
    assert np.array_equal(frames["action.b"].to_numpy(), marked)
    (session,) = read_info(folder, "about")["sessions"]
    outcomes = {episode["name"]: episode["outcome"] for episode in session["episodes"]}
    assert outcomes == {"one": "succeeded", "two": "failed", "three": "not stated"}
    assert session["frames_outside_episodes"] == 90
    tasks = pd.read_parquet(folder / "meta" / "tasks.parquet")
    assert tasks.index.tolist() == ["stack the cups"]


def test_unmarked_logs_are_one_reported_episode(tmp_path: Path) -> None:
    settings = {"episodes": "marks"}
    summary = Exporter("lerobot", tmp_path / "said", settings=settings).export(make_users_log())
    assert f"no episode is marked in {make_users_log().source}" in summary
    assert "no episode is marked" not in Exporter("lerobot", tmp_path / "log").export(
        make_users_log()
    )
    folder = export_logs(tmp_path, make_users_log(), episodes="marks")
    assert read_frames(folder)["next.done"].to_list() == 179 * [False] + [True]
    assert "next.success" not in read_frames(folder).columns


def test_an_episode_outside_the_records_is_refused(tmp_path: Path) -> None:
    late = rewrite_log(make_users_log(), others=[make_event("episode one begins", 7.0)])
    with pytest.raises(LogError, match="no marked episode contains a time"):
        export_logs(tmp_path, late, episodes="marks")


def test_slave_references_are_optional_observations(tmp_path: Path) -> None:
    folder = export_logs(tmp_path, make_users_log(), observations="reference")
    names = read_info(folder)["features"]["observation.state"]["names"]
    assert names[:2] + names[4:] == ["c.q1.pos", "c.q2.pos", "c.q1.ref", "c.q2.ref"]
    state = read_frames(folder)["observation.state"].to_numpy()
    assert np.array_equal(state[:, 4:], read_newest(make_users_log(), "c", "q_des", 180, 30))


def test_the_environment_state_is_the_state(tmp_path: Path) -> None:
    folder = export_logs(tmp_path, make_users_log(), environment_state="yes")
    features = read_info(folder)["features"]
    assert features["observation.environment_state"] == features["observation.state"]
    state = read_frames(folder)["observation.state"].to_numpy()
    assert np.array_equal(
        read_frames(folder)["observation.environment_state"].to_numpy(), state
    )


def test_the_plugin_needs_a_holdable_arm(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="needs an operator of kind 'live' or 'own' at b"):
        export_logs(tmp_path, make_users_log(), observations="plugin")
    with pytest.raises(UsageError, match="the plugin can hold the arm of a or b, not of 'c'"):
        export_logs(tmp_path, make_users_log(), observations="plugin", site="c")


def test_episodes_end_before_gaps(tmp_path: Path) -> None:
    """Records from 1.0 to 1.5 s are missing, but 1.0 s and 3.0 s still have a record of 5 ms before."""
    folder = export_logs(tmp_path, make_users_log_without((1.0, 1.5), (3.0, 3.02)))
    lengths = read_frames(folder, "meta/episodes")["length"].to_list()
    assert lengths == [31, 135]
    assert read_info(folder, "about")["sessions"][0]["frames_left_out"] == 180 - 31 - 135
    frames = read_frames(folder)
    recorded = read_newest(make_users_log(), "c", "q", 180, 30)
    assert frames["timestamp"][31] == frames["frame_index"][31] == 0
    q = frames["observation.state"].to_numpy()[:, :2]
    assert np.array_equal(q[:30], recorded[:30])
    assert q[30].tolist() == np.float32(make_users_log()["c"].by_tick[199].q).tolist()
    assert (np.flatnonzero((q[31:] != recorded[45:]).any(axis=1)) + 45).tolist() == [90]
    assert q[31 + 45].tolist() == np.float32(make_users_log()["c"].by_tick[599].q).tolist()


def test_logs_become_episodes_of_one_set(tmp_path: Path) -> None:
    again = trilat_net.simulate(
        make_users_log().scenario.text.replace("seed = 5", "seed = 6").replace("busy", "other")
    )
    folder = export_logs(tmp_path, make_users_log(), again)
    episodes = read_frames(folder, "meta/episodes")
    assert episodes["dataset_from_index"].to_list() == [0, 180]
    assert (
        episodes["dataset_to_index"].to_list()
        == [180, 360]
        == np.cumsum(episodes["length"]).tolist()
    )
    assert episodes["tasks"].to_list() == [["busy"], ["other"]]
    frames = read_frames(folder)
    assert frames["index"].to_list() == list(range(360))
    assert frames["frame_index"].to_list() == 2 * list(range(180))
    assert (
        frames["task_index"].to_list()
        == frames["episode_index"].to_list()
        == [0] * 180 + [1] * 180
    )
    tasks = pd.read_parquet(folder / "meta" / "tasks.parquet")
    assert tasks.index.tolist() == ["busy", "other"]
    assert tasks["task_index"].tolist() == [0, 1]
    assert read_info(folder)["total_frames"] == 360


def test_python_takes_paths_and_logs_together(tmp_path: Path) -> None:
    """The path of a run of 0.2 s, and the log of it with another seed: six frames each, one task."""
    first, second = (trilat_net.simulate("paper", duration_s=0.2, seed=seed) for seed in (1, 2))
    path = first.save(tmp_path / "first.mcap")
    folder = trilat_net.export(
        [second, path], "lerobot", tmp_path / "set", fps=30, program="m1"
    )
    assert read_info(folder)["total_episodes"] == 2
    assert read_info(folder)["total_tasks"] == 1
    assert read_info(folder, "about")["program"] == "m1"
    assert read_frames(folder)["intervention"].to_list() == [False] * 12


def test_statistics_are_those_of_the_frames(tmp_path: Path) -> None:
    folder = export_logs(tmp_path, make_users_log_without((1.0, 1.5)))
    frames = read_frames(folder)["action.a"].to_numpy().astype(np.float64)
    stats = read_info(folder, "meta/stats")["action.a"]
    assert stats["count"] == [len(frames)]
    assert stats["std"] == pytest.approx(frames.std(axis=0))
    assert stats["q90"] == pytest.approx(np.quantile(frames, 0.9, axis=0))
    episodes = read_frames(folder, "meta/episodes")
    for n, (first, end) in enumerate(pairwise([0, *episodes["dataset_to_index"]])):
        assert episodes["stats/action.a/max"][n].to_list() == pytest.approx(
            frames[first:end].max(axis=0)
        )


def test_other_arms_are_refused_without_files(tmp_path: Path) -> None:
    other = trilat_net.simulate("two_sites", duration_s=0.2)
    with pytest.raises(LogError, match="the users or joints are not the same as in"):
        export_logs(tmp_path, make_users_log(), other)
    assert not list(tmp_path.iterdir())


def test_one_user_leads_alone_and_is_a_scalar(tmp_path: Path) -> None:
    folder = export_logs(tmp_path, trilat_net.simulate("two_sites", duration_s=0.2))
    assert read_frames(folder)["dominance"].to_list() == [1.0] * 6
    assert read_info(folder)["features"]["dominance"]["shape"] == [1]


def test_in_task_space_a_command_is_a_place(tmp_path: Path) -> None:
    source = trilat_net.simulate(parse_scenario(planar_task_text(0.2)))
    folder = export_logs(tmp_path, source)
    assert read_info(folder)["features"]["action"]["names"] == ["x.pos", "y.pos", "z.pos"]
    assert np.array_equal(
        read_frames(folder)["action"].to_numpy(), read_newest(source, "m", "x", 6, 30)
    )


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"fps": "0"}, "not 0"),
        ({"fps": "thirty"}, "fps of lerobot must be a whole number, not 'thirty'"),
        ({"fps": 29.97}, "fps of lerobot must be a whole number, not '29.97'"),
        ({"observations": "all"}, "observations must be slave or reference or plugin"),
        ({"environment_state": True}, "environment_state must be no or yes, not 'True'"),
        ({"episodes": "mark"}, "episodes must be log or marks, not 'mark'"),
    ],
)
def test_invalid_settings_are_refused(
    settings: dict[str, Any], said: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=said):
        Exporter("lerobot", tmp_path / "set", settings=settings).export(make_users_log())


def test_forms_without_settings_are_reported(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="csv has no setting 'fps'; csv has no settings"):
        Exporter("csv", tmp_path / "set", settings={"fps": 30})
    with pytest.raises(UsageError, match="exports a single log"):
        Exporter("csv", tmp_path / "set").export(make_users_log(), make_users_log())


def test_other_actions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="actions must be tip or joints, not 'arms'"):
        export_logs(tmp_path, make_users_log(), actions="arms")
    with pytest.raises(UsageError, match="csv has no setting 'actions'"):
        Exporter("csv", tmp_path / "csv", settings={"actions": "tip"})


def test_different_joints_are_told_to_use_tips(tmp_path: Path) -> None:
    source = trilat_net.simulate(parse_scenario(posed_task_text(0.1)))
    with pytest.raises(LogError, match=r"m2 and m1 have different joints, .*: use actions tip"):
        export_logs(tmp_path, source, actions="joints")
    folder = export_logs(tmp_path, source, actions="tip")
    assert read_info(folder)["features"]["action"]["names"] == ["x.pos", "y.pos", "z.pos"]
