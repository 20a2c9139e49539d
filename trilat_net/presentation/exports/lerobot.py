"""Exports logs as a LeRobot dataset, version 3.0, for learning from demonstrations.

LeRobot trains programs to control robots by imitating people. A dataset is a sequence of frames
at a fixed rate, divided into episodes. Each frame contains the state of the slave arm, the pose
of every user's arm, the dominance factors of the users, the ages of the samples that the sites
use to follow each other, and, in a run with a program, whether a person intervened.

Invariant:
    - A frame contains, for every site, the most recent record at or before the time of the
      frame. Nothing is interpolated.
    - A frame is dropped if such a record is older than both the control period of the site and
      the frame period. In that case the episode ends, and the next one begins after the gap.
    - Observations and actions are states of a site at the time of the frame, taken from the
      site's own records. Link delays therefore affect only the samples of peers. The features
      `age_s` are the ages of these samples.
    - Numbers are float32. An orientation is stored as six numbers, which never jump (see
      `trilat_net.log.orientations`).
    - With the setting `actions`, actions have the names and units of `action_features` of the
      plugin `lerobot_robot_trilat`, so that a trained program can command the plugin. With
      `observations=plugin`, observations also have the names and units used by the plugin. A
      test compares them.
    - The column `intervention` exists only if a program moves the arm of a user in at least one
      of the logs.
"""

import json
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...analysis import DominanceHistory, SharedSlave, build_arm_rows
from ...core import POSITION, Array
from ...errors import LogError, UsageError, count_nouns, join_words
from ...files import Extra
from ...log import MATRIX_ENTRIES, Ints, Log, collect_provenance, expand_poses
from ...records import NS_PER_S
from ...scenario import TASK_AXES
from ..export import EXPORT_MANIFEST, ExportFormat, Written
from ..lerobot_observation import find_plugin_actions, observe_as_plugin

_EXTRA = Extra("lerobot", "datasets of LeRobot")
_PARQUET_MODULE = "pyarrow.parquet"
_FILE = "chunk-000/file-000.parquet"
_MEANINGS = {
    "observation.state": (
        "angles, rad, and velocities, rad/s, of the slave's joints; with "
        "observations=reference also the reference that it follows (.ref), in the units of the "
        "actions that sites share; with observations=plugin the observation of "
        "lerobot_robot_trilat. All are states of a site at the frame, without delays of links"
    ),
    "observation.environment_state": "the same numbers, for policies that need this name",
    "action": (
        "pose of the arm of the leading user at the frame; action.USER is the pose of the arm "
        "of each user: angles, rad, or a position, m, and an orientation"
    ),
    "r11.rot": (
        "an orientation is six entries of the rotation matrix, its first and second column"
    ),
    "dominance": "share of each user in the slave's reference, Eq. (6); the largest one leads",
    "tau_x": (
        "external torque of Eq. (8) at the slave, N m; tau_x.USER is the torque that the hand "
        "of each user feels"
    ),
    "age_s": (
        "age, s, of the sample of each user that the slave follows at the frame, as the delays "
        "of the links make it; age_s.USER is the age of the sample of the slave that the site "
        "of each user has in use. Before the first sample, the time since the start of the "
        "session"
    ),
    "intervention": "true if a user other than the program leads; left out without a program",
    "next.done": "true in the last frame of an episode",
    "next.success": (
        "true in the last frame of an episode that a mark of the log calls succeeded; false "
        "also if no mark says how the episode ended"
    ),
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
"""Metadata that make pandas, which LeRobot uses, read the task descriptions as an index."""
_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
"""Quantiles that LeRobot expects in the statistics of a feature."""
ACTIONS = ("tip", "joints")
"""Kinds of actions: end effector positions, or joint angles.

These are also the modes of the LeRobot plugin that moves an arm to a position. If the setting
is omitted, actions are the values that the sites exchange.
"""
OBSERVATIONS = ("slave", "reference", "plugin")
"""Kinds of observations.

These are the joints of the slave, the same joints with the reference that the slave follows,
and the observation of the LeRobot plugin.
"""
EPISODES = ("log", "marks")
"""Ways to divide runs into episodes: one per log, or by the marks set with `session.episode`.
"""
SWITCHES = ("no", "yes")
NO_PROGRAM = "none"
"""Value of the setting `program` for runs in which no program moves an arm."""
_EPISODE_MARK = re.compile(r"episode (.+) (begins|ended|succeeded|failed)", re.DOTALL)
_OUTCOMES = {"succeeded": True, "failed": False}
Names = dict[str, list[str]]
"""Mapping from feature name to the names of its components."""
Columns = dict[str, NDArray[Any]]
"""Mapping from feature name to its values in all frames, shape (F, n) or (F,)."""


class _Feature(NamedTuple):
    """A vector with n components per frame of a dataset, such as the joint angles of an arm.

    Attributes:
        key: Name of the feature in the dataset.
        values: The values, shape (F, n).
        names: Names of the n components.
    """

    key: str
    values: Array
    names: list[str]


class _Attempt(NamedTuple):
    """A part of a run that becomes an episode of the dataset: one attempt at a task.

    Its start and end are marked by a program with `session.episode`.

    Attributes:
        name: Name of the episode. Empty for a run without marks.
        begin_ns: Start of the attempt, in ns since the start of the session.
        end_ns: End of the attempt (exclusive). `None` if it lasts until the end of the log.
        succeeded: Whether the task was completed. `None` if no mark states the outcome.
    """

    name: str
    begin_ns: int = 0
    end_ns: int | None = None
    succeeded: bool | None = None


class _Frames(NamedTuple):
    """The F frames of a dataset, each of which refers to one record per site.

    The frames are equally spaced in time, except at gaps between episodes.

    Attributes:
        rows: For each site, the record index of each frame in the log, shape (F,).
        episode: Episode number of each frame, starting from 0, shape (F,).
        left_out: Number of frames dropped because they lie in gaps.
        outside: Number of frames dropped because they lie outside the attempts.
        attempts: Attempts that contain the frames.
        attempt: Index of each frame's attempt, shape (F,).
    """

    rows: dict[str, Ints]
    episode: Ints
    left_out: int
    outside: int
    attempts: list[_Attempt]
    attempt: Ints


class _Settings(NamedTuple):
    """Settings of an export of logs, see `_write`."""

    actions: str
    observations: str
    environment_state: bool
    program: str
    site: str


def _write(
    logs: Sequence[Log],
    folder: Path,
    written: Written,
    *,
    fps: int = 30,
    program: str = "",
    actions: str = "",
    observations: str = "slave",
    site: str = "",
    environment_state: str = "no",
    task: str = "",
    episodes: str = "log",
) -> str:
    """Exports logs as one LeRobot dataset for training robot policies.

    An episode of the dataset is one run, or one attempt within a run.

    Args:
        logs: The logs, at least one.
        folder: Folder of the dataset.
        written: Function that is called with the number of records of every log.
        fps: Number of frames per second.
        program: Name of the user that is the program, or `NO_PROGRAM`. Empty to determine it
            for each log.
        actions: Kind of the actions, one of `ACTIONS`. If empty, the plugin's actions for
            plugin observations, and otherwise the values that the sites exchange.
        observations: Kind of the observations, one of `OBSERVATIONS`.
        site: Name of the user whose arm the plugin will move. If empty, the program or, without
            a program, the last user.
        environment_state: "yes" to store the observation also under the name
            `observation.environment_state`, which some policies require.
        task: Description of the task. Empty for the title of the scenario.
        episodes: How runs are divided into episodes, one of `EPISODES`.

    Returns:
        A sentence about the size of the dataset.

    Raises:
        LogError: A log has no frames, or the users or joints of the logs differ.
        UsageError: A setting is not valid.
    """
    if fps < 1:
        raise UsageError(
            f"fps must be a whole number of frames per second, at least 1, not {fps}"
        )

    if actions:
        _check_choice("actions", actions, ACTIONS)
    _check_choice("observations", observations, OBSERVATIONS)
    _check_choice("environment_state", environment_state, SWITCHES)
    _check_choice("episodes", episodes, EPISODES)

    programs = [program or SharedSlave(log).program or NO_PROGRAM for log in logs]
    names: Names = {}
    tasks: dict[str, int] = {}
    parts = list[Columns]()
    sessions = []
    left_out = 0
    outside = 0
    without_marks = []
    plugin_site = ""
    for log, log_program in zip(logs, programs, strict=True):
        settings = _Settings(
            actions=actions,
            observations=observations,
            environment_state=environment_state == "yes",
            program=log_program,
            site=site,
        )
        attempts = _find_attempts(log) if episodes == "marks" else []
        if episodes == "marks" and not attempts:
            without_marks.append(log.source)
        frames = _choose_frames(log, fps, attempts or [_Attempt("")])
        columns, log_names = _read_columns(log, frames.rows, settings)
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
        task_text = task or log.scenario.title or log.scenario.name
        task_index = tasks.setdefault(task_text, len(tasks))
        columns["task_index"] = np.full_like(frames.episode, task_index)
        columns["next.success"] = _find_successes(frames)
        parts.append(columns)
        session = _describe_session(log, frames, log_program)
        if observations == "plugin":
            plugin_site = _choose_plugin_site(log, settings)
            session["plugin_site"] = plugin_site
        sessions.append(session)
        left_out += frames.left_out
        outside += frames.outside
        record_count = sum(len(log[name]) for name in log.sites)
        written(record_count)

    has_program = any(log_program != NO_PROGRAM for log_program in programs)
    has_outcome = any(
        attempt["outcome"] != "not stated"
        for session in sessions
        for attempt in session["episodes"]
    )
    for part in parts:
        if not has_program:
            del part["intervention"]
        if not has_outcome:
            del part["next.success"]
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
    program_text = " and ".join(sorted(set(programs)))
    files[EXPORT_MANIFEST] = {
        "exported_by": f"trilat-net {version}",
        "meanings": _MEANINGS,
        "actions": actions or ("plugin" if observations == "plugin" else "what sites share"),
        "observations": observations,
        "program": program_text,
        "sessions": sessions,
    }
    _write_json(folder, files)

    frames_text = count_nouns(frame_count, "frame")
    episodes_text = count_nouns(episode_count, "episode")
    gaps_text = count_nouns(
        left_out, "frame lies in a gap and is", "frames lie in gaps and are"
    )
    text = f"{frames_text} in {episodes_text}; {gaps_text} left out"
    if outside:
        text += f"; {count_nouns(outside, 'frame')} outside the marked episodes"
    if without_marks:
        text += (
            f"; no episode is marked in {join_words(without_marks)}: all of each log is one "
            "(tn.session(NAME).episode marks episodes)"
        )
    if plugin_site:
        text += f"; observations as the plugin makes them at {plugin_site}"
    if not has_program:
        return f"{text}; no program moved an arm, so there is no column intervention"

    found = "" if program else " (found in the log)"
    return f"{text}; the program is {program_text}{found}"


def _check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raises UsageError if a setting does not have one of its possible values.

    Args:
        name: Name of the setting.
        value: Value of the setting.
        choices: The possible values.

    Raises:
        UsageError: The value is not one of the choices.
    """
    if value not in choices:
        raise UsageError(f"{name} must be {' or '.join(choices)}, not {value!r}")


def _choose_plugin_site(log: Log, settings: _Settings) -> str:
    """Chooses the user whose arm the LeRobot plugin, a learnt policy, will move later.

    This is the user named in the settings, otherwise the program or, without a program, the
    last user.

    Args:
        log: Log of a run with at least one user.
        settings: Settings of the export, with the program of this log.

    Raises:
        UsageError: The settings name a user that does not exist.
    """
    users = SharedSlave(log).users
    program = settings.program if settings.program != NO_PROGRAM else ""
    site = settings.site or program or users[-1]
    if site not in users:
        user_names = " or ".join(users)
        raise UsageError(f"the plugin can hold the arm of {user_names}, not of {site!r}")
    return site


def _find_attempts(log: Log) -> list[_Attempt]:
    """Finds the episodes that the user marked during the session.

    `session.episode` writes a mark at the start and at the end of an episode. An episode
    without an end mark lasts until the next episode begins.

    Args:
        log: Log of the run.

    Returns:
        The episodes in chronological order. Empty if there are none.
    """
    episode_marks = []
    for event in log.events:
        match = _EPISODE_MARK.fullmatch(event.text)
        if event.kind == "mark" and match:
            episode_marks.append((event.t_ns, match[1], match[2]))
    episode_marks.sort(key=lambda mark: mark[0])  # stable: keeps the order of marks in one tick

    attempts = list[_Attempt]()
    for t_ns, name, phase in episode_marks:
        last_attempt = attempts[-1] if attempts else None
        is_open = last_attempt is not None and last_attempt.end_ns is None
        if phase == "begins":
            if last_attempt is not None and is_open:
                attempts[-1] = last_attempt._replace(end_ns=t_ns)
            attempts.append(_Attempt(name, begin_ns=t_ns))
        # The mark ends the open episode. Marks of other episodes have no effect.
        elif last_attempt is not None and is_open and last_attempt.name == name:
            attempts[-1] = last_attempt._replace(end_ns=t_ns, succeeded=_OUTCOMES.get(phase))
    return attempts


def _find_successes(frames: _Frames) -> NDArray[np.bool_]:
    """Returns a mask of the frames at which an attempt ends with success, shape (F,)."""
    succeeded = np.array([attempt.succeeded is True for attempt in frames.attempts])
    is_last = np.diff(frames.attempt, append=len(frames.attempts)) != 0
    successes: NDArray[np.bool_] = is_last & succeeded[frames.attempt]
    return successes


def _write_json(folder: Path, files: dict[str, Any]) -> None:
    """Writes the JSON files of a LeRobot dataset to its folder.

    Args:
        folder: The folder.
        files: Mapping from file name to contents.
    """
    for file_name, content in files.items():
        text = json.dumps(content, indent=4) + "\n"
        path = folder / file_name
        path.write_text(text, encoding="utf-8", newline="\n")


def _describe_session(log: Log, frames: _Frames, program: str) -> dict[str, Any]:
    """Returns the facts about a log that are stored in the manifest of a dataset.

    These are the session and its scenario, the program that moved an arm, the marked episodes
    with their outcomes, and the number of dropped frames.
    """
    outcomes = {True: "succeeded", False: "failed", None: "not stated"}
    episodes = []
    for attempt in frames.attempts:
        if attempt.name:
            outcome = outcomes[attempt.succeeded]
            episodes.append({"name": attempt.name, "outcome": outcome})
    return {
        **log.session,
        "scenario": log.scenario_text,
        "program": program,
        "episodes": episodes,
        "frames_left_out": frames.left_out,
        "frames_outside_episodes": frames.outside,
    }


def _number_frames(dataset: Columns, fps: int) -> list[int]:
    """Adds the time and the index of each frame, which LeRobot requires, to a dataset.

    The time and the frame index start at 0 in each episode. The last frame of an episode is
    marked as done.

    Args:
        dataset: Columns of all frames, to which the new columns are added.
        fps: Number of frames per second.

    Returns:
        Index of the first frame of each episode.
    """
    episode = dataset["episode_index"]
    index = np.arange(len(episode))

    # An episode begins where the number of the episode changes.
    episode_steps = np.diff(episode, prepend=-1)
    starts = np.flatnonzero(episode_steps)
    is_last = np.diff(episode, append=episode[-1] + 1) != 0
    dataset["next.done"] = is_last

    frame_index = index - starts[episode]
    times_s = frame_index / fps
    dataset["timestamp"] = times_s.astype(np.float32)

    dataset["frame_index"] = frame_index
    dataset["index"] = index
    return [int(start) for start in starts]


def _choose_frames(log: Log, fps: int, attempts: list[_Attempt]) -> _Frames:
    """Chooses the times of the frames of a log, and the record of each site for each frame.

    The first frame is at the first time for which every site has a record. Records of a site
    that has diverged are not used.

    Args:
        log: Log of the run to export.
        fps: Number of frames per second.
        attempts: Parts of the run from which frames are taken, in chronological order.

    Raises:
        LogError: A site has no records, or there is no time (in the log or in an attempt) for
            which every site has a record.
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

    if not is_fresh.any():
        raise LogError(f"{log.source}: there is no time for which every site has a record")

    attempt = np.full(len(frame_ns), -1)
    for index, part in enumerate(attempts):
        is_inside = frame_ns >= part.begin_ns
        if part.end_ns is not None:
            is_inside &= frame_ns < part.end_ns
        attempt[is_inside] = index
    is_inside = attempt >= 0
    chosen = np.flatnonzero(is_fresh & is_inside)
    if not len(chosen):
        raise LogError(
            f"{log.source}: no marked episode contains a time for which every site has a "
            "record; without episodes=marks the whole log is one episode"
        )

    chosen_attempt = attempt[chosen]
    frame_steps = np.diff(chosen, prepend=chosen[0])
    attempt_steps = np.diff(chosen_attempt, prepend=chosen_attempt[0])
    begins_episode = (frame_steps > 1) | (attempt_steps != 0)
    chosen_rows = {site: site_rows[chosen] for site, site_rows in rows.items()}
    inside_count = int(is_inside.sum())
    return _Frames(
        rows=chosen_rows,
        episode=np.cumsum(begins_episode, dtype=np.int64),
        left_out=inside_count - len(chosen),
        outside=len(frame_ns) - inside_count,
        attempts=attempts,
        attempt=chosen_attempt,
    )


def _read_columns(
    log: Log,
    rows: dict[str, Ints],
    settings: _Settings,
) -> tuple[Columns, Names]:
    """Returns the features of all frames of a log that are derived from its records.

    A feature is a vector per frame, such as the state of the slave.

    Args:
        log: Log of the run to export.
        rows: For each site, the record index of each frame, shape (F,).
        settings: Settings of the export, with the program of this log.

    Returns:
        The columns of the features, and the component names of each vector. Without a program,
        the column `intervention` is false.

    Raises:
        LogError: The log has no slave or no user, or the users have no common action.
        UsageError: The program or the user of the plugin is not a user, or the plugin cannot
            hold an arm in this scenario.
    """
    shared_slave = SharedSlave(log)
    slave = shared_slave.name
    users = shared_slave.users
    if not slave or not users:
        raise LogError(f"{log.source}: the session must have a slave and at least one master")

    slave_records = log[slave]
    slave_rows = rows[slave]
    frame_times_s = slave_records.t_s[slave_rows]
    dominance = DominanceHistory.of_log(log, slave, frame_times_s)
    has_program = settings.program != NO_PROGRAM
    program = settings.program if has_program else ""
    shared = shared_slave.find_shares(dominance.alpha, program)
    # Without a program, the first user leads if no share is larger than the others.
    leader = shared.leader if has_program else shared.shares.argmax(axis=1)
    plugin_site = _choose_plugin_site(log, settings)
    actions = settings.actions
    if settings.observations == "plugin" and not actions:
        actions = find_plugin_actions(log, plugin_site)
    commands, command_names = _read_commands(log, users, rows, actions)
    # The action of a frame is the command of the user with the largest dominance factor.
    all_commands = np.stack(commands)
    frame_indices = np.arange(len(dominance.alpha))
    leading_commands = all_commands[leader, frame_indices]

    q = slave_records.q[slave_rows]
    qd = slave_records.qd[slave_rows]
    state = np.hstack([q, qd])
    joints: Names = {}
    for site in (slave, *users):
        arm = log.scenario.arms[site]
        joints[site] = list(arm.joint_names)
    state_names = [f"{slave}.{joint}.pos" for joint in joints[slave]]
    state_names += [f"{slave}.{joint}.vel" for joint in joints[slave]]
    if settings.observations == "plugin":
        state, state_names = observe_as_plugin(log, slave, plugin_site, rows)
    if settings.observations == "reference":
        reference, coordinates = _read_reference(log, slave, slave_rows)
        state = np.hstack([state, reference])
        state_names += [f"{slave}.{name}.ref" for name in coordinates]

    features = [_Feature("observation.state", state, state_names)]
    if settings.environment_state:
        environment = _Feature("observation.environment_state", state, state_names)
        features.append(environment)
    leading_action = _Feature("action", leading_commands, command_names)
    features.append(leading_action)
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
    features += _read_sample_ages(log, rows, slave, users)

    columns: Columns = {}
    names: Names = {}
    for feature in features:
        columns[feature.key] = feature.values.astype(np.float32)
        names[feature.key] = feature.names
    columns["intervention"] = has_program & (leader != shared.program)
    return columns, names


def _read_sample_ages(
    log: Log, rows: dict[str, Ints], slave: str, users: Sequence[str]
) -> list[_Feature]:
    """Returns the ages of the samples with which the slave and its users follow each other.

    The age of a sample is the delay that a control loop experiences. A trained program may need
    it to judge how outdated its view of the other arm is. The feature `age_s` contains the ages
    at the slave, one per user, and `age_s.USER` contains the age of the slave's sample at a
    user. Sites that do not follow each other have no such feature.

    Args:
        log: Log of the run to export.
        rows: For each site, the record index of each frame, shape (F,).
        slave: Name of the slave.
        users: Names of the users' sites.
    """
    features = []
    followed_users = [user for user in users if user in log[slave].used]
    if followed_users:
        ages_of_users = [_read_ages(log, slave, user)[rows[slave]] for user in followed_users]
        features.append(_Feature("age_s", np.stack(ages_of_users, axis=1), followed_users))

    for user in users:
        if slave in log[user].used:
            user_ages = _read_ages(log, user, slave)[rows[user]]
            features.append(_Feature(f"age_s.{user}", user_ages[:, np.newaxis], [slave]))
    return features


def _read_ages(log: Log, receiver: str, sender: str) -> Array:
    """Returns the age of the sample in use at each record of the receiver, in s, shape (K,).

    Before the first sample, the age is the time since the start of the session, as for a
    program that moves an arm (`PeerView`). NaN is not used, because it would make all
    statistics NaN.

    Args:
        log: Log of the run to export.
        receiver: Name of the site that receives samples.
        sender: Name of the peer that sends them.
    """
    records = log[receiver]
    ages_or_nan_s = records.age_s(sender, log[sender].rate_hz)
    elapsed_s = records.t_ns / NS_PER_S
    ages_s: Array = np.where(np.isnan(ages_or_nan_s), elapsed_s, ages_or_nan_s)
    return ages_s


def _read_reference(log: Log, slave: str, rows: Ints) -> tuple[Array, list[str]]:
    """Returns the pose that the slave arm follows in each frame, with its component names.

    A learning program uses this reference q_des as the action of the demonstrator.

    Args:
        log: Log of the run to export.
        slave: Name of the slave.
        rows: Record index of the slave in each frame, shape (F,).

    Returns:
        The reference, shape (F, n), and the names of the joints or, in task space, of the axes
        and the entries of the rotation matrix.
    """
    reference = log[slave].q_des[rows]
    if not log[slave].layout.task:
        return reference, list(log.scenario.arms[slave].joint_names)
    expanded = expand_poses(reference)
    names = [*TASK_AXES[:POSITION], *MATRIX_ENTRIES]
    return expanded, names[: expanded.shape[1]]


def _read_commands(
    log: Log,
    users: Sequence[str],
    rows: dict[str, Ints],
    actions: str,
) -> tuple[list[Array], list[str]]:
    """Returns the commands of every user, which a learning program uses as actions.

    A user commands the robot by moving a master arm, so the commands are the positions of its
    end effector, the poses that the sites exchange, or its joint angles.

    Args:
        log: Log of the run to export.
        users: Names of the users' sites.
        rows: For each site, the record index of each frame, shape (F,).
        actions: Kind of the actions, one of `ACTIONS`, or empty.

    Returns:
        The commands of each user, shape (F, n), and the names of the n components.

    Raises:
        LogError: The arms of the users have different joints, so there is no common action.
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
    """Writes the frames and episodes of a dataset as Parquet files in LeRobot's layout.

    Args:
        folder: Folder of the dataset.
        dataset: Columns of all frames.
        starts: Index of the first frame of each episode.
        tasks: Task descriptions.

    Returns:
        Statistics of the dataset, for storage in a JSON file.
    """
    pa = _EXTRA.import_module("pyarrow")
    parquet = _EXTRA.import_module(_PARQUET_MODULE)
    frames = {}
    for key, column in dataset.items():
        # A vector with one number is stored as a plain number.
        size = column[0].size
        numbers = column.ravel()
        if size > 1:
            numbers = pa.FixedSizeListArray.from_arrays(numbers, size)
        frames[key] = numbers

    # LeRobot needs a row with statistics per episode, and a table with the texts of the tasks.
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
    """Returns the contents of meta/info.json, the file that describes a LeRobot dataset.

    The file states how many episodes there are, where they are stored, and which features each
    frame contains.

    Args:
        fps: Number of frames per second.
        names: Component names of each feature.
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
    """Returns the table row of an episode: its frames, its length and its task.

    Args:
        dataset: Columns of all frames.
        first: Index of the first frame of the episode.
        end: Index after the last frame.
        tasks: Task descriptions.
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
    """Computes the statistics that LeRobot uses to normalise a feature.

    Features are normalised before training, because they differ in magnitude.

    Args:
        column: Feature in F frames, shape (F, n) or (F,).

    Returns:
        Mapping from the name of each statistic to its n values.
    """
    frame_rows = column.reshape(len(column), -1).astype(np.float64)
    statistics = {
        "min": np.min(frame_rows, axis=0).tolist(),
        "max": np.max(frame_rows, axis=0).tolist(),
        "mean": np.mean(frame_rows, axis=0).tolist(),
        "std": np.std(frame_rows, axis=0).tolist(),
    }
    for quantile in _QUANTILES:
        quantiles = np.quantile(frame_rows, quantile, axis=0)
        percent = 100 * quantile
        statistics[f"q{percent:02.0f}"] = quantiles.tolist()
    statistics["count"] = [len(frame_rows)]
    return statistics


FORMAT = ExportFormat(
    _write, "-lerobot", folder=True, extra=_EXTRA, module=_PARQUET_MODULE, many=True
)
