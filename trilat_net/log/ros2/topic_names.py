"""Defines the names of a session's topics in ROS 2, for the live bridge and for bags.

The live bridge publishes a running session as ROS 2 topics. A bag is a recording of such
topics, to which a log can be converted. The user chooses one of two naming conventions, or
overrides names in a TOML file.

Invariant:
    - A name that begins with / is a full name. Any other name is relative to
      `/<session>/<site>`.
    - No two topics have the same name.
    - A topic has the same name in a bag as in the live bridge.
"""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ...errors import UsageError, count_nouns, suggest_nearest
from ...files import open_regular
from ...net.ros2 import check_ros_name
from ...scenario import Scenario

NAMINGS = ("crisp", "crtk")
"""The two built-in conventions: CRISP, and the Collaborative Robotics Toolkit (CRTK)."""
TOPICS = {
    "joint_states": ("joint_states", "measured_js"),
    "reference": ("reference", "setpoint_js"),
    "tip_pose": ("tip_pose", "measured_cp"),
    "tip_twist": ("tip_twist", "measured_cv"),
    "tip_wrench": ("tip_wrench", "measured_cf"),
    "reference_pose": ("reference_pose", "setpoint_cp"),
    "reference_twist": ("reference_twist", "setpoint_cv"),
    "mode": ("mode", "mode"),
    "mode_number": ("mode_number", "mode_number"),
    "dominance": ("dominance", "dominance"),
    "robot_description": ("robot_description", "robot_description"),
    "error": ("error", "error"),
    "tau_x": ("tau_x", "tau_x"),
    "theta_hat": ("theta_hat", "theta_hat"),
    "link_age": ("link_age", "link_age"),
    "link_delay": ("link_delay", "link_delay"),
    "link_offset": ("link_offset", "link_offset"),
    "timing": ("timing", "timing"),
    "target_joint": ("target_joint", "servo_jp"),
    "target_pose": ("target_pose", "servo_cp"),
    "target_wrench": ("target_wrench", "servo_cf"),
    "set_dominance": ("set_dominance", "set_dominance"),
    "robot_states": ("robot/joint_states", "robot/measured_js"),
    "robot_commands": ("robot/commands", "robot/commands"),
}
"""Maps the trilat-net name of each topic to its name below `/<session>/<site>` in each of
`NAMINGS`.

CRISP is a set of ROS 2 controllers. CRTK is the convention of the da Vinci Research Kit. A
vector that a control law sends has the same name in both: "sent_" followed by the name of the
vector.
"""
FRAMES_TOPIC = "tf"
"""Topic for the poses of all links, with the name that ROS tools expect."""
DIAGNOSTICS = "diagnostics"
"""Topic for the status of all sites, with the name that ROS tools expect."""


class RobotTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a real robot that serves as a site's arm, from the file with the ROS 2 names.

    Attributes:
        joints: Names of the joints in the robot's messages, in scenario order. If empty, the
            names of the scenario are used.
        controller: The same names in the order in which the robot's controller expects its
            commands (controller order). If empty, scenario order is used.
        safe: Command sent to the controller while the arm brakes, one number per joint in
            controller order. If empty, zeros are sent.
    """

    joints: list[str] = []
    controller: list[str] = []
    safe: list[float] = []


class TopicTable(NamedTuple):
    """Names of a session's topics in ROS 2, as chosen by the user.

    Attributes:
        names: Maps the trilat-net name of each topic to its ROS 2 name.
        of_site: For each site that has its own topic names, maps the trilat-net name of a topic
            to its ROS 2 name.
        robots: Maps the names of sites with a real robot to the settings of the robot.
    """

    names: Mapping[str, str]
    of_site: Mapping[str, Mapping[str, str]] = {}
    robots: Mapping[str, RobotTable] = {}

    def refuse_other_robots(self, scenario: Scenario) -> None:
        """Raises UsageError if robot settings do not fit the external arms of the scenario.

        An external arm is a real arm, or a simulation in another program. Robot settings only
        make sense for a site with an external arm. For any other site of the scenario, settings
        that equal the defaults are tolerated, because they have no effect.

        Args:
            scenario: Scenario of the session.

        Raises:
            UsageError: Robot settings are given for a site that is not in the scenario or has
                no external arm, or the robot does not have as many joints as the arm of its
                site.
        """
        for site, robot in self.robots.items():
            has_external_arm = site in scenario.outside
            is_unknown = site not in scenario.names
            differs_from_defaults = robot != RobotTable()
            if not has_external_arm and (differs_from_defaults or is_unknown):
                outside = ", ".join(scenario.outside) or "none"
                raise UsageError(
                    f"--names: sites.{site}: no site of this name has an external arm; sites "
                    f"with an external arm: {outside}"
                )

            if has_external_arm and robot.joints:
                joints = scenario.arms[site].joint_names
                if len(robot.joints) != len(joints):
                    names_text = count_nouns(len(robot.joints), "name")
                    joints_text = count_nouns(len(joints), "joint")
                    raise UsageError(
                        f"--names: sites.{site}.joints has {names_text}, but the arm of {site} "
                        f"has {joints_text}: {', '.join(joints)}"
                    )

    def find(self, session: str, site: str, topic: str) -> str:
        """Returns the full ROS 2 name of a site's topic, without the leading slash.

        The user's names take precedence over those of trilat-net.

        Args:
            session: Name of the session.
            site: Name of the site.
            topic: Name of the topic in trilat-net.
        """
        common_name = self.names.get(topic, topic)
        site_names = self.of_site.get(site, {})
        name = site_names.get(topic, common_name)
        if name.startswith("/"):
            return name[1:]
        return f"{session}/{site}/{name}"

    @classmethod
    def read(cls, source: str) -> "TopicTable":
        """Reads the ROS 2 names for the topics of a session.

        The names follow a built-in convention, or come from a TOML file. The conventions are
        "crisp" (a set of ROS 2 controllers) and "crtk" (the Collaborative Robotics Toolkit).
        The file lists only the names that differ from "crisp". For example, the line
        `joint_states = "arm/joint_states"` applies to all sites, whereas a table `[sites.s]`
        applies only to the site `s`. Such a table may also contain the settings of a real
        robot, which are the fields of `RobotTable`.

        Args:
            source: "crisp", "crtk" or the path of a file.

        Returns:
            The names, and the settings of real robots.

        Raises:
            UsageError: The file cannot be read, or contains an invalid name.
        """
        if source in NAMINGS:
            return TopicTable(_list_names(source))
        changes = _read_names_file(source)
        _check_names(source, changes.names)
        for site_names in changes.of_site.values():
            _check_names(source, site_names)
        all_names = {**_list_names("crisp"), **changes.names}
        table = changes._replace(names=all_names)
        _check_unique_names(source, table)
        return table


def make_session_name(text: str) -> str:
    """Converts the name of a session to a valid ROS 2 name.

    Characters that are not allowed in ROS 2 names are replaced with underscores.

    Args:
        text: Name of the session.
    """
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return name if name[:1].isalpha() else f"_{name}"


def _list_names(naming: str) -> dict[str, str]:
    """Returns the name of each topic in a built-in convention."""
    naming_index = NAMINGS.index(naming)
    return {topic: names[naming_index] for topic, names in TOPICS.items()}


def _read_names_file(source: str) -> TopicTable:
    """Reads a user's file with names of ROS 2 topics and settings of robots.

    Raises:
        UsageError: The file cannot be read, or is not valid TOML.
    """
    try:
        with open_regular(Path(source)) as stream:
            text = stream.read().decode()
        names = tomllib.loads(text)
        site_tables = names.pop("sites", {})
        site_names = msgspec.convert(site_tables, dict[str, dict[str, Any]])
        robot_fields: dict[str, dict[str, Any]] = {}
        # The table of a site contains both names of topics and fields of the site's robot.
        for site, table in site_names.items():
            field_names = [key for key in RobotTable.__struct_fields__ if key in table]
            robot_fields[site] = {key: table.pop(key) for key in field_names}
        robots = msgspec.convert(robot_fields, dict[str, RobotTable])
    except OSError as error:
        raise UsageError(
            f"--names must be crisp, crtk or the path of a file, but {source} cannot be read: "
            f"{error.strerror}"
        ) from None
    except (ValueError, msgspec.ValidationError) as error:
        raise UsageError(f"{source} is not a valid TOML file of names: {error}") from None
    return TopicTable(names, site_names, robots)


def _check_names(source: str, names: Mapping[str, object]) -> None:
    """Raises UsageError if a renamed topic does not exist or its new name is invalid in ROS 2.

    Args:
        source: Name of the file, for the error message.
        names: Maps names in trilat-net to names in ROS 2.

    Raises:
        UsageError: A topic does not exist, or a name is not valid.
    """
    for topic, name in names.items():
        if topic not in TOPICS:
            known_topics = list(TOPICS)
            suggestion = suggest_nearest(topic, known_topics)
            raise UsageError(f"{source}: there is no topic {topic!r}{suggestion}")
        if not isinstance(name, str):
            raise UsageError(f"{source}: {topic} must be a string in quotes, not {name!r}")
        check_ros_name(name, f"{source}: {topic}")


def _check_unique_names(source: str, table: TopicTable) -> None:
    """Raises UsageError if two quantities have the same topic name in ROS 2.

    Args:
        source: Name of the file, for the error message.
        table: The names.

    Raises:
        UsageError: Two topics have the same name.
    """
    # One message may contain the states of several robots, so `robot_states` may repeat.
    topics = [topic for topic in TOPICS if topic != "robot_states"]
    # Two invented sites represent the sites without changed names. They show whether several
    # sites use a full name, which begins with /.
    full_names: list[str] = []
    for site in (*table.of_site, "*", "**"):
        full_names += [table.find("", site, topic) for topic in topics]
    different_names = set(full_names)
    if len(different_names) < len(full_names):
        raise UsageError(
            f"{source}: two topics have the same name; a name that begins with / can be used "
            "for one site only"
        )
