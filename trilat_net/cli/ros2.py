"""`trilat ros2`: a session in the graph of ROS 2, over Zenoh and without an installation of ROS."""

from functools import partial
from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from . import options
from .options import check_range, value

_ROUTER = "tcp/127.0.0.1:7447"


@options.command("--session paper", "--session paper --ros tcp/192.0.2.7:7447 --domain 3")
def ros2_command(
    session: Annotated[str, value("--session", "ID", "Session to show.")],
    ros: Annotated[
        list[str] | None,
        value("--ros", "EP", f"Endpoint of ROS's Zenoh router (rmw_zenohd); default: {_ROUTER}."),
    ] = None,
    domain: Annotated[int, value("--domain", "N", "ROS_DOMAIN_ID.", min=0, max=232)] = 0,
    distro: Annotated[
        str,
        value("--ros-distro", "humble|jazzy|kilted|lyrical", "Distribution of ROS 2 whose form is written."),
    ] = "jazzy",
    rate: Annotated[
        float,
        value(
            "--rate",
            "HZ",
            "Messages a second of each topic.",
            callback=check_range(1.0, 20_000.0, "a rate, Hz,"),
        ),
    ] = 100.0,
    timeout: options.AnswerOption = 10.0,
    *,
    reach: options.Reach,
) -> None:
    """Shows a session to ROS 2, and lets its programs hold arms: topics, services and transforms.

    ROS needs RMW_IMPLEMENTATION=rmw_zenoh_cpp and its router; nothing of ROS is needed here. The bridge waits
    for the router, and ends with the session. docs/ros2.md has all topics and services.
    """
    from sites.ros2_bridge import serve_ros2
    from sites.running_session import RunningSession

    from ..errors import UsageError
    from ..net.ros2_node import Ros2Node
    from ..net.ros2_wire import DISTROS, check_ros_name
    from ..process import Interrupt

    if distro not in DISTROS:
        raise UsageError(f"--ros-distro is one of {', '.join(DISTROS)}, not {distro!r}")
    name = check_ros_name(options.check_session_name(session), "session")
    running = RunningSession(name, reach.resolve())
    open_node = partial(Ros2Node, ros or [_ROUTER], name, "trilat", domain, distro)
    with Interrupt() as interrupt:
        serve_ros2(running, open_node, rate, interrupt.requested, terminal.print_line, timeout)
    if interrupt.requested():
        raise typer.Exit(interrupt.exit_code)
