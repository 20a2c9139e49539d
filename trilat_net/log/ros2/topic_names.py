"""Names of the topics of a session in ROS 2: one table for the live bridge and for bags.

Invariant:
- A name that begins with / stands for itself, and no two topics have one name.
- What a bag has of a session stands there under the name that the live bridge gives it.
"""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ...errors import UsageError
from ...fields import suggest_nearest
from ...files import open_regular
from ...net.ros2_names import check_ros_name

NAMINGS = ("crisp", "crtk")
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
"""By our name of a topic the one that it has under `/<session>/<site>` in each of `NAMINGS`: as
CRISP, and as the Collaborative Robotics Toolkit of the da Vinci Research Kit call it. What a
law sends is "sent_" and the name of the vector, in every naming.
"""
FRAMES = "tf"
DIAGNOSTICS = "diagnostics"
"""Topics of all sessions together, where tools of ROS look for them."""


class RobotTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a file says of the robot that is the arm of a site.

    Attributes:
        joints: its names of the arm's joints, in the scenario's order; empty: as the scenario
            calls them.
        controller: the same in the order of its controller; empty: in that of the scenario.
        safe: what this controller gets while the arm is to brake, in its order; empty: zeros.
    """

    joints: list[str] = []
    controller: list[str] = []
    safe: list[float] = []


class TopicTable(NamedTuple):
    """By our names of topics those that they have at every site, and where a site has others;
    the robots.
    """

    names: Mapping[str, str]
    of_site: Mapping[str, Mapping[str, str]] = {}
    robots: Mapping[str, RobotTable] = {}

    def find(self, session: str, site: str, topic: str) -> str:
        """Returns the full name of a topic of a site; one that begins with / stands for itself."""
        called = self.of_site.get(site, {}).get(topic, self.names.get(topic, topic))
        return called[1:] if called.startswith("/") else f"{session}/{site}/{called}"


def make_session_name(text: str) -> str:
    """Returns the name of a session as a name of ROS 2: other characters become _."""
    bare = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return bare if bare[:1].isalpha() else f"_{bare}"


def read_topic_table(asked: str) -> TopicTable:
    """Returns the names of "crisp" or "crtk", or those of a file, which is TOML upon those of
    CRISP.

    As in `joint_states = "arm/joint_states"`; a table `[sites.s]` is for one site, and says of
    its robot what a `RobotTable` has.

    Raises:
        UsageError: it cannot be read, or a name in it cannot be right.
    """
    plain = {
        topic: row[NAMINGS.index(asked) if asked in NAMINGS else 0]
        for topic, row in TOPICS.items()
    }
    if asked in NAMINGS:
        return TopicTable(plain)
    try:
        with open_regular(Path(asked)) as stream:
            found = tomllib.loads(stream.read().decode())
        tables = msgspec.convert(found.pop("sites", {}), dict[str, dict[str, Any]])
        of_robot = RobotTable.__struct_fields__
        own = {
            site: {key: of.pop(key) for key in of_robot if key in of}
            for site, of in tables.items()
        }
        robots = msgspec.convert(own, dict[str, RobotTable])
    except OSError as error:
        raise UsageError(
            f"--names is crisp, crtk or a file, and {asked} cannot be read: {error.strerror}"
        ) from None
    except (ValueError, msgspec.ValidationError) as error:
        raise UsageError(f"{asked}: is no TOML of names: {error}") from None
    for key, name in [pair for table in (found, *tables.values()) for pair in table.items()]:
        if key not in TOPICS:
            raise UsageError(f"{asked}: no topic {key!r}{suggest_nearest(key, list(TOPICS))}")
        check_ros_name(str(name), f"{asked}: {key}")
    table = TopicTable(plain | found, tables, robots)
    # several arms may stand in one message
    shown = [topic for topic in TOPICS if topic != "robot_states"]
    places = [table.find("", site, topic) for site in (*tables, "*", "**") for topic in shown]
    if len(set(places)) < len(places):
        raise UsageError(
            f"{asked}: two topics have one name; one that begins with / is for one site"
        )
    return table
