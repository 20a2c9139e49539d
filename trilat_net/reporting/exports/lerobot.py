"""A dataset of LeRobot, v3.0: what each user commands, who leads, and where a person
intervened.

Invariant:
- A frame has of every site the newest record at or before its time, as float32; nothing is
  interpolated.
- Where that record is older than a period of the site and of the frames an episode ends, and
  the next one begins behind the gap.
- An orientation is six numbers, which never jump (see `trilat_net.log.orientations`).
- With `actions`, the names and units of actions are those of `action_features` of the plugin
  `lerobot_robot_trilat` (a test compares them).
"""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...analysis.arm_rows import build_arm_rows
from ...analysis.dominance_history import find_user_shares, find_users, trace_dominance
from ...core.task_space import POSITION
from ...core.ticks import NS_PER_S
from ...core.vectors import Array
from ...errors import LogError, UsageError, count_nouns
from ...files import import_extra
from ...log.log_layout import collect_provenance
from ...log.log_reader import Log
from ...log.orientations import MATRIX_ENTRIES, expand_poses
from ...log.record_columns import Ints
from ...scenario.arms import TASK_AXES
from ..export import EXPORT_MANIFEST, ExportFormat, Written

_EXTRA = ("pyarrow.parquet", "lerobot", "datasets of LeRobot")
_FILE = "chunk-000/file-000.parquet"
_MEANINGS = {
    "observation.state": "angles, rad, and velocities, rad/s, of the slave's joints",
    "action": "command of the leading user, action.USER of each: angles, rad; or a place, m, and its turn",
    "r11.rot": "a turn is six entries of the rotation matrix: its first column and its second one",
    "dominance": "share of each user in the slave's reference, Eq. (6); the largest one leads",
    "tau_x": "external torque of Eq. (8) at the slave, N m; tau_x.USER: what the hand of each user feels",
    "intervention": "true where another user than the program leads",
    "frame": "of each site the newest record at or before its time; nothing is interpolated",
}
_INDEX = {
    "name": "task",
    "field_name": "task",
    "pandas_type": "unicode",
    "numpy_type": "object",
}
_PANDAS = {
    "pandas": json.dumps({"index_columns": ["task"], "column_indexes": [], "columns": [_INDEX]})
}
"""By this the reader of LeRobot, pandas, takes the texts of tasks for its index."""
ACTIONS = ("tip", "joints")
"""What actions may be besides what sites share: the modes of the plugin's hand that go to a
place.
"""
Names = dict[str, list[str]]
Columns = dict[str, NDArray[Any]]
"""Columns of frames by the names of their features, shape (K, n) or (K,)."""


def _write(
    logs: Sequence[Log],
    folder: Path,
    written: Written,
    *,
    fps: int = 30,
    program: str = "",
    actions: str = "",
) -> str:
    if fps < 1:
        raise UsageError(f"fps is a whole number of frames a second, not {fps}")
    if actions not in ("", *ACTIONS):
        raise UsageError(f"actions are {' or '.join(ACTIONS)}, not {actions!r}")
    tasks: dict[str, int] = {}
    names: Names = {}
    parts = list[Columns]()
    sessions = []
    lost = 0
    for log in logs:
        rows, episode, left_out = _find_rows(log, fps)
        columns, found = _read_columns(log, rows, program, actions)
        if (names := names or found) != found:
            raise LogError(
                f"{log.source}: its users and joints are not those of {logs[0].source}"
            )
        columns["episode_index"] = episode + (
            parts[-1]["episode_index"][-1] + 1 if parts else 0
        )
        task = tasks.setdefault(log.scenario.title or log.scenario.name, len(tasks))
        parts.append({**columns, "task_index": np.full_like(episode, task)})
        sessions.append(
            {**log.session, "scenario": log.scenario_text, "frames_left_out": left_out}
        )
        lost += left_out
        written(sum(len(log[site]) for site in log.sites))
    whole = {key: np.concatenate([one[key] for one in parts]) for key in parts[0]}
    index = np.arange(len(whole["episode_index"]))
    starts = np.flatnonzero(np.diff(whole["episode_index"], prepend=-1))
    frame = index - starts[whole["episode_index"]]
    whole |= {
        "timestamp": (frame / fps).astype(np.float32),
        "frame_index": frame,
        "index": index,
    }
    texts = _store_tables(folder, whole, [*starts.tolist(), len(index)], list(tasks))
    texts["meta/info.json"] = _describe_set(
        fps=fps, names=names, whole=whole, episodes=len(starts), tasks=len(tasks)
    )
    about: dict[str, Any] = {
        "exported_by": f"trilat-net {collect_provenance()['version_trilat-net']}",
        "meanings": _MEANINGS,
    }
    about |= {"actions": actions or "what sites share", "program": program or "the last user"}
    texts[EXPORT_MANIFEST] = {**about, "sessions": sessions}
    for place, content in texts.items():
        (folder / place).write_text(
            json.dumps(content, indent=4) + "\n", encoding="utf-8", newline="\n"
        )
    return (
        f"{count_nouns(len(index), 'frame')} in {count_nouns(len(starts), 'episode')}; "
        f"{count_nouns(lost, 'frame lies in a gap and is', 'frames lie in gaps and are')} left out"
    )


def _find_rows(log: Log, fps: int) -> tuple[dict[str, Ints], Ints, int]:
    """Returns per site the rows of the frames' records, each frame's episode, and how many are
    left out.
    """
    kept = {site: np.flatnonzero(log[site].mode != "diverged") for site in log.sites}
    if empty := [site for site, rows in kept.items() if not len(rows)]:
        raise LogError(f"{log.source}: no records of {', '.join(empty)}")
    stamps = {
        site: log[site].tick[rows] * NS_PER_S // log[site].rate_hz
        for site, rows in kept.items()
    }
    begin_ns = max(t[0] for t in stamps.values())
    end_ns = min(t[-1] for t in stamps.values())
    at_ns = begin_ns + np.arange((end_ns - begin_ns) * fps // NS_PER_S + 1) * NS_PER_S // fps
    fresh = np.ones(len(at_ns), dtype=np.bool_)
    for site, t_ns in stamps.items():
        row = np.searchsorted(t_ns, at_ns, side="right") - 1
        fresh &= at_ns - t_ns[row] <= NS_PER_S // min(fps, log[site].rate_hz)
        kept[site] = kept[site][row]
    if not len(frames := np.flatnonzero(fresh)):
        raise LogError(f"{log.source}: there is no time of which every site has a record")
    episode = np.cumsum(np.diff(frames, prepend=frames[0]) > 1, dtype=np.int64)
    return (
        {site: rows[frames] for site, rows in kept.items()},
        episode,
        len(at_ns) - len(frames),
    )


def _read_columns(
    log: Log, rows: dict[str, Ints], program: str, actions: str
) -> tuple[Columns, Names]:
    """Returns the columns of all frames, and the names of their numbers."""
    slave, users = find_users(log.scenario)
    if not slave or not users:
        raise LogError(f"{log.source}: it has no slave that a master leads")
    alpha = trace_dominance(log, slave, log[slave].t_s[rows[slave]]).alpha
    shared = find_user_shares(log.scenario, alpha, program)
    joints = {site: list(log.scenario.arms[site].joint_names) for site in (slave, *users)}

    def read(site: str, field: str) -> Array:
        return np.asarray(getattr(log[site], field)[rows[site]])

    commands, commanded = _read_commands(log, users, rows, actions)
    state = [f"{slave}.{one}.{what}" for what in ("pos", "vel") for one in joints[slave]]
    found = [
        ("observation.state", np.hstack([read(slave, "q"), read(slave, "qd")]), state),
        ("action", np.stack(commands)[shared.leader, np.arange(len(alpha))], commanded),
        *(
            (f"action.{user}", one, commanded)
            for user, one in zip(users, commands, strict=True)
        ),
        ("dominance", shared.shares, users),
        ("tau_x", read(slave, "tau_x"), joints[slave]),
        *((f"tau_x.{user}", read(user, "tau_x"), joints[user]) for user in users),
    ]
    columns: Columns = {key: values.astype(np.float32) for key, values, _ in found}
    return {**columns, "intervention": shared.leader != shared.program}, {
        key: names for key, _, names in found
    }


def _read_commands(
    log: Log, users: Sequence[str], rows: dict[str, Ints], actions: str
) -> tuple[list[Array], list[str]]:
    """Returns what each user commands, shape (K, n) each, and the names of its numbers.

    Raises:
        LogError: the users' arms have other joints, so that no action is both's.
    """
    if actions == "tip":
        tips = []
        for user in users:
            q = log[user].q[rows[user]]
            qd = log[user].qd[rows[user]]
            tips.append(build_arm_rows(log.scenario, user).place_end_effector(q, qd).position)
        return tips, [f"{axis}.pos" for axis in TASK_AXES[: tips[0].shape[1]]]
    if not actions and log[users[0]].layout.task:
        poses = [expand_poses(log[user].x[rows[user]]) for user in users]
        places = [f"{axis}.pos" for axis in TASK_AXES[:POSITION]]
        turned = [f"{entry}.rot" for entry in MATRIX_ENTRIES]
        return poses, [*places, *turned][: poses[0].shape[1]]
    joints = {
        user: [f"{name}.pos" for name in log.scenario.arms[user].joint_names] for user in users
    }
    if other := next((user for user in users if joints[user] != joints[users[0]]), None):
        text = f"the joints of {other} are not those of {users[0]}, so that an action cannot stand for both"
        raise LogError(f"{log.source}: {text}: use --actions tip")
    return [log[user].q[rows[user]] for user in users], joints[users[0]]


def _store_tables(
    folder: Path, whole: Columns, edges: list[int], tasks: list[str]
) -> dict[str, Any]:
    """Stores the tables of a dataset, and returns its statistics by their place."""
    pa = import_extra("pyarrow", *_EXTRA[1:])
    parquet = import_extra(*_EXTRA)
    vectors = {
        key: pa.FixedSizeListArray.from_arrays(one.ravel(), one[0].size)
        if one[0].size > 1
        else one.ravel()
        for key, one in whole.items()
    }
    described = [_describe_episode(whole, *ends, tasks) for ends in pairwise(edges)]
    texts = pa.table({"task_index": np.arange(len(tasks)), "task": tasks})
    tables = {
        f"data/{_FILE}": pa.table(vectors),
        f"meta/episodes/{_FILE}": pa.Table.from_pylist(described),
        "meta/tasks.parquet": texts.replace_schema_metadata(_PANDAS),
    }
    for place, table in tables.items():
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        with (folder / place).open(
            "wb"
        ) as stream:  # a full disk is reported here, not by pyarrow
            parquet.write_table(table, stream)
    return {"meta/stats.json": {key: _describe(one) for key, one in whole.items()}}


def _describe_set(
    fps: int, names: Names, whole: Columns, episodes: int, tasks: int
) -> dict[str, Any]:
    return {
        "codebase_version": "v3.0",
        "robot_type": "trilat",
        "fps": fps,
        "total_episodes": episodes,
        "total_frames": len(whole["index"]),
        "total_tasks": tasks,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "splits": {"train": f"0:{episodes}"},
        "features": {
            key: {"dtype": str(one.dtype), "shape": [one[0].size], "names": names.get(key)}
            for key, one in whole.items()
        },
    }


def _describe_episode(whole: Columns, first: int, end: int, tasks: list[str]) -> dict[str, Any]:
    stats = {key: _describe(values[first:end]) for key, values in whole.items()}
    return {
        "episode_index": int(whole["episode_index"][first]),
        "tasks": [tasks[whole["task_index"][first]]],
        "length": end - first,
        "dataset_from_index": first,
        "dataset_to_index": end,
        **{
            f"{of}/{which}_index": 0
            for of in ("data", "meta/episodes")
            for which in ("chunk", "file")
        },
        **{
            f"stats/{key}/{name}": one
            for key, found in stats.items()
            for name, one in found.items()
        },
    }


def _describe(values: NDArray[Any]) -> dict[str, list[float]]:
    """Returns what LeRobot scales a feature by, of each of its numbers."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    found = {
        name: getattr(np, name)(rows, axis=0).tolist() for name in ("min", "max", "mean", "std")
    }
    for share in (0.01, 0.1, 0.5, 0.9, 0.99):
        found[f"q{100 * share:02.0f}"] = np.quantile(rows, share, axis=0).tolist()
    return {**found, "count": [len(rows)]}


FORMAT = ExportFormat(_write, "-lerobot", folder=True, extra=_EXTRA, many=True)
