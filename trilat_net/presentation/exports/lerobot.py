"""Exports logs as a dataset of LeRobot, version 3.0, for learning from demonstrations.

LeRobot trains programs to move robots like people did. A dataset is a sequence of frames at a
fixed rate, divided into episodes. A frame has the state of the slave arm, the command of every
user, the dominance factors of the users (the weights with which the slave follows them), and
whether a person intervened in place of the program.

Invariant:
    - A frame has the newest record of every site at or before its time. A record is the stored
      result of one period of the control loop of the arm. Nothing is interpolated.
    - A frame is left out if such a record is older than the period of the site's control loop
      and also older than the period of the frames. Then its episode ends, and the next one
      begins after the gap.
    - Numbers are float32. An orientation is six numbers, which never jump (see
      `trilat_net.log.orientations`).
    - With the setting `actions`, actions have the names and units of `action_features` of the
      plugin `lerobot_robot_trilat`, so that a trained program can command the plugin. A test
      compares the two.
"""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...analysis.arm_rows import build_arm_rows
from ...analysis.dominance_history import find_user_shares, find_users, trace_dominance
from ...core.arms.task_space import POSITION
from ...core.step.ticks import NS_PER_S
from ...core.step.vectors import Array
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
    "action": (
        "command of the leading user; action.USER is the command of each user: angles, rad, or "
        "a position, m, and an orientation"
    ),
    "r11.rot": (
        "an orientation is six entries of the rotation matrix, its first and second column"
    ),
    "dominance": "share of each user in the slave's reference, Eq. (6); the largest one leads",
    "tau_x": (
        "external torque of Eq. (8) at the slave, N m; tau_x.USER is the torque that the hand "
        "of each user feels"
    ),
    "intervention": "true if a user other than the program leads",
    "frame": (
        "the newest record of each site at or before the time of the frame; nothing is "
        "interpolated"
    ),
}
_INDEX = {
    "name": "task",
    "field_name": "task",
    "pandas_type": "unicode",
    "numpy_type": "object",
}
_INDEX_TABLE = {
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [_INDEX],
}
_PANDAS = {"pandas": json.dumps(_INDEX_TABLE)}
"""Metadata with which pandas, which LeRobot uses, reads the texts of tasks as an index."""
_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
"""Quantiles that LeRobot expects among the statistics of a feature."""
ACTIONS = ("tip", "joints")
"""Kinds of actions: positions of the end effector, or joint angles.

These are also the modes of the LeRobot plugin that moves an arm to a position. Without one of
them, actions are the values that the sites exchange.
"""
Names = dict[str, list[str]]
"""Names of the numbers of each feature."""
Columns = dict[str, NDArray[Any]]
"""Columns of frames by the names of their features, shape (F, n) or (F,)."""


class _Feature(NamedTuple):
    """A vector of n numbers in each of F frames, such as the state of the slave.

    Attributes:
        key: Name of the feature in the dataset.
        values: The numbers, shape (F, n).
        names: Names of the n numbers.
    """

    key: str
    values: Array
    names: list[str]


class _Frames(NamedTuple):
    """The F frames of a data set, each of which refers to a record of every site.

    The frames are equally spaced in time, except at gaps between episodes.

    Attributes:
        rows: For each site, the index of each frame's record in the log, shape (F,).
        episode: Number of each frame's episode, from 0, shape (F,).
        left_out: Number of frames that are left out, because they lie in gaps.
    """

    rows: dict[str, Ints]
    episode: Ints
    left_out: int


def _write(
    logs: Sequence[Log],
    folder: Path,
    written: Written,
    *,
    fps: int = 30,
    program: str = "",
    actions: str = "",
) -> str:
    """Writes logs as one dataset.

    Args:
        logs: The logs, at least one.
        folder: Folder of the dataset.
        written: Function that is called with the number of records of every log.
        fps: Number of frames per second.
        program: Name of the user that is the program. Empty for the last user.
        actions: Kind of the actions, one of `ACTIONS`. Empty for the values that sites
            exchange.

    Returns:
        A sentence about the size of the dataset.

    Raises:
        LogError: A log has no frames, or the users or joints of the logs differ.
        UsageError: A setting is not valid.
    """
    _check_settings(fps, actions)
    names: Names = {}
    tasks: dict[str, int] = {}
    parts = list[Columns]()
    sessions = []
    left_out = 0
    for log in logs:
        frames = _choose_frames(log, fps)
        columns, log_names = _read_columns(log, frames.rows, program, actions)
        names = names or log_names
        if log_names != names:
            first_source = logs[0].source
            raise LogError(
                f"{log.source}: the users or joints are not the same as in {first_source}"
            )
        first_episode = 0
        if parts:
            last_episode = parts[-1]["episode_index"][-1]
            first_episode = last_episode + 1
        columns["episode_index"] = frames.episode + first_episode
        task_text = log.scenario.title or log.scenario.name
        task = tasks.setdefault(task_text, len(tasks))
        columns["task_index"] = np.full_like(frames.episode, task)
        parts.append(columns)
        sessions.append(_describe_session(log, frames))
        left_out += frames.left_out
        record_count = sum(len(log[site]) for site in log.sites)
        written(record_count)

    dataset: Columns = {}
    for key in parts[0]:
        column_parts = [part[key] for part in parts]
        dataset[key] = np.concatenate(column_parts)
    starts = _number_frames(dataset, fps)
    files = _write_tables(folder, dataset, starts, list(tasks))
    frame_count = len(dataset["index"])
    episode_count = len(starts)
    files["meta/info.json"] = _describe_dataset(
        fps=fps,
        names=names,
        columns=dataset,
        episodes=episode_count,
        tasks=len(tasks),
    )
    provenance = collect_provenance()
    version = provenance["version_trilat-net"]
    files[EXPORT_MANIFEST] = {
        "exported_by": f"trilat-net {version}",
        "meanings": _MEANINGS,
        "actions": actions or "what sites share",
        "program": program or "the last user",
        "sessions": sessions,
    }
    _write_json(folder, files)

    frames_text = count_nouns(frame_count, "frame")
    episodes_text = count_nouns(episode_count, "episode")
    gaps_text = count_nouns(
        left_out, "frame lies in a gap and is", "frames lie in gaps and are"
    )
    return f"{frames_text} in {episodes_text}; {gaps_text} left out"


def _check_settings(fps: int, actions: str) -> None:
    """Checks the settings of an export, see `_write`.

    Raises:
        UsageError: A setting is not valid.
    """
    if fps < 1:
        raise UsageError(
            f"fps must be a whole number of frames per second, at least 1, not {fps}"
        )
    if actions not in ("", *ACTIONS):
        raise UsageError(f"actions must be {' or '.join(ACTIONS)}, not {actions!r}")


def _write_json(folder: Path, files: dict[str, Any]) -> None:
    """Writes JSON files into a folder.

    Args:
        folder: The folder.
        files: Contents of the files by name.
    """
    for file_name, content in files.items():
        text = json.dumps(content, indent=4) + "\n"
        path = folder / file_name
        path.write_text(text, encoding="utf-8", newline="\n")


def _describe_session(log: Log, frames: _Frames) -> dict[str, Any]:
    """Returns the session of a log, its scenario, and the number of omitted frames."""
    return {
        **log.session,
        "scenario": log.scenario_text,
        "frames_left_out": frames.left_out,
    }


def _number_frames(dataset: Columns, fps: int) -> list[int]:
    """Adds the time and the numbers of all frames to a dataset.

    Args:
        dataset: Columns of all frames, to which columns are added.
        fps: Number of frames per second.

    Returns:
        Index of the first frame of each episode.
    """
    episode = dataset["episode_index"]
    index = np.arange(len(episode))
    episode_steps = np.diff(episode, prepend=-1)
    starts = np.flatnonzero(episode_steps)
    frame_index = index - starts[episode]
    times_s = frame_index / fps
    dataset["timestamp"] = times_s.astype(np.float32)
    dataset["frame_index"] = frame_index
    dataset["index"] = index
    return [int(start) for start in starts]


def _choose_frames(log: Log, fps: int) -> _Frames:
    """Chooses the times of the frames of a log, and the records of each frame.

    The first frame is at the first time for which every site has a record. Records of a site
    that has diverged do not count.

    Raises:
        LogError: A site has no records, or there is no time for which every site has a record.
    """
    rows = {}
    for site in log.sites:
        has_not_diverged = log[site].mode != "diverged"
        rows[site] = np.flatnonzero(has_not_diverged)
    empty_sites = [site for site, site_rows in rows.items() if not len(site_rows)]
    if empty_sites:
        sites_text = ", ".join(empty_sites)
        raise LogError(
            f"{log.source}: the log has no records of {sites_text}; records of a site that has "
            "diverged do not count"
        )
    stamps_ns = {}
    for site, site_rows in rows.items():
        records = log[site]
        ticks = records.tick[site_rows]
        stamps_ns[site] = ticks * NS_PER_S // records.rate_hz

    # Frames are at equal steps over the time for which all sites have records.
    first_times_ns = [t_ns[0] for t_ns in stamps_ns.values()]
    last_times_ns = [t_ns[-1] for t_ns in stamps_ns.values()]
    begin_ns = max(first_times_ns)
    end_ns = min(last_times_ns)
    count = (end_ns - begin_ns) * fps // NS_PER_S + 1
    frame_ns = begin_ns + np.arange(count) * NS_PER_S // fps

    is_fresh = np.ones(len(frame_ns), dtype=np.bool_)
    for site, t_ns in stamps_ns.items():
        newest = np.searchsorted(t_ns, frame_ns, side="right") - 1
        age_ns = frame_ns - t_ns[newest]
        lower_rate_hz = min(fps, log[site].rate_hz)
        longer_period_ns = NS_PER_S // lower_rate_hz
        is_fresh &= age_ns <= longer_period_ns
        rows[site] = rows[site][newest]

    fresh_frames = np.flatnonzero(is_fresh)
    if not len(fresh_frames):
        raise LogError(f"{log.source}: there is no time for which every site has a record")
    frame_steps = np.diff(fresh_frames, prepend=fresh_frames[0])
    is_after_gap = frame_steps > 1
    fresh_rows = {site: site_rows[fresh_frames] for site, site_rows in rows.items()}
    return _Frames(
        rows=fresh_rows,
        episode=np.cumsum(is_after_gap, dtype=np.int64),
        left_out=len(frame_ns) - len(fresh_frames),
    )


def _read_columns(
    log: Log,
    rows: dict[str, Ints],
    program: str,
    actions: str,
) -> tuple[Columns, Names]:
    """Returns the features of all frames of a log that follow from its records.

    A feature is a vector per frame, such as the state of the slave.

    Args:
        log: Log of the run that is exported.
        rows: For each site, the index of each frame's record, shape (F,).
        program: Name of the user that is the program. Empty for the last user.
        actions: Kind of the actions, one of `ACTIONS`, or empty.

    Returns:
        The columns of the features, and the names of the numbers of each vector.

    Raises:
        LogError: The log has no slave or no user, or the users have no common action.
        UsageError: The program is not a user.
    """
    slave, users = find_users(log.scenario)
    if not slave or not users:
        raise LogError(f"{log.source}: the session must have a slave and at least one master")

    slave_records = log[slave]
    slave_rows = rows[slave]
    frame_times_s = slave_records.t_s[slave_rows]
    dominance = trace_dominance(log, slave, frame_times_s)
    shared = find_user_shares(log.scenario, dominance.alpha, program)
    commands, command_names = _read_commands(log, users, rows, actions)
    # The action of a frame is the command of the user with the largest dominance factor.
    all_commands = np.stack(commands)
    frame_indices = np.arange(len(dominance.alpha))
    leading_commands = all_commands[shared.leader, frame_indices]

    q = slave_records.q[slave_rows]
    qd = slave_records.qd[slave_rows]
    state = np.hstack([q, qd])
    joints: Names = {}
    for site in (slave, *users):
        arm = log.scenario.arms[site]
        joints[site] = list(arm.joint_names)
    state_names = [f"{slave}.{joint}.pos" for joint in joints[slave]]
    state_names += [f"{slave}.{joint}.vel" for joint in joints[slave]]

    features = [
        _Feature("observation.state", state, state_names),
        _Feature("action", leading_commands, command_names),
    ]
    for user, command in zip(users, commands, strict=True):
        user_action = _Feature(f"action.{user}", command, command_names)
        features.append(user_action)
    slave_torques = slave_records.tau_x[slave_rows]
    features.append(_Feature("dominance", shared.shares, users))
    features.append(_Feature("tau_x", slave_torques, joints[slave]))
    for user in users:
        user_rows = rows[user]
        user_torques = log[user].tau_x[user_rows]
        features.append(_Feature(f"tau_x.{user}", user_torques, joints[user]))

    columns: Columns = {}
    names: Names = {}
    for feature in features:
        columns[feature.key] = feature.values.astype(np.float32)
        names[feature.key] = feature.names
    columns["intervention"] = shared.leader != shared.program
    return columns, names


def _read_commands(
    log: Log,
    users: Sequence[str],
    rows: dict[str, Ints],
    actions: str,
) -> tuple[list[Array], list[str]]:
    """Returns the commands of every user.

    Args:
        log: Log of the run that is exported.
        users: Names of the sites of the users.
        rows: For each site, the index of each frame's record, shape (F,).
        actions: Kind of the actions, one of `ACTIONS`, or empty.

    Returns:
        The commands of each user, shape (F, n), and the names of their n numbers.

    Raises:
        LogError: The users' arms have different joints, so the users have no common action.
    """
    if actions == "tip":
        positions = []
        for user in users:
            records = log[user]
            user_rows = rows[user]
            arm_rows = build_arm_rows(log.scenario, user)
            q = records.q[user_rows]
            qd = records.qd[user_rows]
            end_effector = arm_rows.place_end_effector(q, qd)
            positions.append(end_effector.position)
        axis_count = positions[0].shape[1]
        axes = TASK_AXES[:axis_count]
        return positions, [f"{axis}.pos" for axis in axes]

    first_user = users[0]
    if not actions and log[first_user].layout.task:
        poses = []
        for user in users:
            user_rows = rows[user]
            exchanged_poses = log[user].x[user_rows]
            poses.append(expand_poses(exchanged_poses))
        names = [f"{axis}.pos" for axis in TASK_AXES[:POSITION]]
        names += [f"{entry}.rot" for entry in MATRIX_ENTRIES]
        entry_count = poses[0].shape[1]
        return poses, names[:entry_count]

    joints = {user: log.scenario.arms[user].joint_names for user in users}
    for user in users:
        if joints[user] != joints[first_user]:
            raise LogError(
                f"{log.source}: {user} and {first_user} have different joints, so the two "
                "users have no common action: use --actions tip"
            )
    angles = []
    for user in users:
        user_rows = rows[user]
        angles.append(log[user].q[user_rows])
    return angles, [f"{joint}.pos" for joint in joints[first_user]]


def _write_tables(
    folder: Path, dataset: Columns, starts: Sequence[int], tasks: list[str]
) -> dict[str, Any]:
    """Writes the tables of a dataset as Parquet files.

    Args:
        folder: Folder of the dataset.
        dataset: Columns of all frames.
        starts: Index of the first frame of each episode.
        tasks: Texts of the tasks.

    Returns:
        Statistics of the dataset, as contents of a JSON file.
    """
    pa = import_extra("pyarrow", *_EXTRA[1:])
    parquet = import_extra(*_EXTRA)
    frames = {}
    for key, column in dataset.items():
        size = column[0].size
        numbers = column.ravel()
        if size > 1:
            numbers = pa.FixedSizeListArray.from_arrays(numbers, size)
        frames[key] = numbers
    frame_count = len(dataset["index"])
    episodes = []
    for first, end in pairwise([*starts, frame_count]):
        episode = _describe_episode(dataset, first, end, tasks)
        episodes.append(episode)
    task_columns = {"task_index": np.arange(len(tasks)), "task": tasks}
    task_table = pa.table(task_columns)
    tables = {
        f"data/{_FILE}": pa.table(frames),
        f"meta/episodes/{_FILE}": pa.Table.from_pylist(episodes),
        "meta/tasks.parquet": task_table.replace_schema_metadata(_PANDAS),
    }
    for file_name, table in tables.items():
        path = folder / file_name
        path.parent.mkdir(parents=True, exist_ok=True)
        # The file is opened by Python and not by pyarrow, so that a full disk raises OSError.
        with path.open("wb") as stream:
            parquet.write_table(table, stream)
    statistics = {key: _compute_statistics(column) for key, column in dataset.items()}
    return {"meta/stats.json": statistics}


def _describe_dataset(
    fps: int, names: Names, columns: Columns, episodes: int, tasks: int
) -> dict[str, Any]:
    """Returns the contents of the file meta/info.json, in which LeRobot looks up the features.

    Args:
        fps: Number of frames per second.
        names: Names of the numbers of each feature.
        columns: Columns of all frames.
        episodes: Number of episodes.
        tasks: Number of tasks.
    """
    features = {}
    for key, column in columns.items():
        features[key] = {
            "dtype": str(column.dtype),
            "shape": [column[0].size],
            "names": names.get(key),
        }
    return {
        "codebase_version": "v3.0",
        "robot_type": "trilat",
        "fps": fps,
        "total_episodes": episodes,
        "total_frames": len(columns["index"]),
        "total_tasks": tasks,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "splits": {"train": f"0:{episodes}"},
        "features": features,
    }


def _describe_episode(
    dataset: Columns, first: int, end: int, tasks: list[str]
) -> dict[str, Any]:
    """Returns the row of an episode in the table of episodes.

    Args:
        dataset: Columns of all frames.
        first: Index of the first frame of the episode.
        end: Index after its last frame.
        tasks: Texts of the tasks.
    """
    task_index = dataset["task_index"][first]
    row: dict[str, Any] = {
        "episode_index": int(dataset["episode_index"][first]),
        "tasks": [tasks[task_index]],
        "length": end - first,
        "dataset_from_index": first,
        "dataset_to_index": end,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    for key, column in dataset.items():
        statistics = _compute_statistics(column[first:end])
        for name, numbers in statistics.items():
            row[f"stats/{key}/{name}"] = numbers
    return row


def _compute_statistics(column: NDArray[Any]) -> dict[str, list[float]]:
    """Computes the statistics of a feature with which LeRobot normalises it.

    Args:
        column: Feature in F frames, shape (F, n) or (F,).

    Returns:
        Each statistic by name, with n numbers.
    """
    rows = column.reshape(len(column), -1).astype(np.float64)
    statistics = {
        "min": np.min(rows, axis=0).tolist(),
        "max": np.max(rows, axis=0).tolist(),
        "mean": np.mean(rows, axis=0).tolist(),
        "std": np.std(rows, axis=0).tolist(),
    }
    for share in _QUANTILES:
        quantiles = np.quantile(rows, share, axis=0)
        percent = 100 * share
        statistics[f"q{percent:02.0f}"] = quantiles.tolist()
    statistics["count"] = [len(rows)]
    return statistics


FORMAT = ExportFormat(_write, "-lerobot", folder=True, extra=_EXTRA, many=True)
