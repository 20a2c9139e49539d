"""The command `trilat ros2`, which connects a running session with ROS 2 programs.

Parses the options, connects to both networks, and starts the bridge in `ros2_bridge`.
"""

from pathlib import Path
from typing import Annotated

import typer

from trilat_net.app import options, value
from trilat_net.errors import UsageError
from trilat_net.net import SystemClock
from trilat_net.presentation import terminal_output as terminal
from trilat_net.signals import Interrupt


@options.command(
    "--session paper",
    "--session paper --ros tcp/192.0.2.7:7447 --domain 3",
    page="docs/sessions/ros2.md",
)
def ros2_command(
    session: Annotated[str, value("--session", "ID", "Session to bridge.")],
    ros: options.RosRouterOption = None,
    domain: options.RosDomainOption = 0,
    distro: Annotated[str, value("--ros-distro", "humble|jazzy|kilted|lyrical")] = "jazzy",
    rate: Annotated[
        float, value("--rate", "HZ", callback=options.check_range(1.0, 20000.0, "a rate in Hz"))
    ] = 100.0,
    names: Annotated[str, value("--names", "crisp|crtk|FILE")] = "crisp",
    rviz: Annotated[Path | None, value("--rviz", "OUT.rviz")] = None,
    timeout: options.AnswerOption = 10.0,
    *,
    reach: options.Reach,
) -> None:
    """Connects a session to ROS 2.

    ROS programs can hold arms, and ROS robots whose controllers accept joint torques can serve
    as arms. ROS must use RMW_IMPLEMENTATION=rmw_zenoh_cpp, and its Zenoh router must be
    running. This machine needs no ROS installation. The bridge waits indefinitely for the ROS
    router, and up to the time given by --timeout for the session. It ends with the session. It
    has been tested against programs that speak the rmw_zenoh protocol, but not with ROS itself
    and not with a robot. docs/reference/ros2-topics.md lists all topics and services.

    Options:
        distro: ROS 2 distribution whose message format the bridge writes.
        rate: Rate of each topic, in Hz.
        names: Naming scheme of the topics: crisp, crtk, or a TOML file that lists topics and
            robots.
        rviz: Write a configuration of RViz that shows the arms of the session.
    """
    from trilat_net.app import RunningSession
    from trilat_net.log.ros2 import TopicTable
    from trilat_net.net import BRIDGE, check_hosts
    from trilat_net.net.ros2 import DISTROS, Refusals, Ros2Graph, check_ros_name

    from .ros2_bridge import serve_ros2

    if distro not in DISTROS:
        raise UsageError(f"--ros-distro must be one of {', '.join(DISTROS)}, not {distro!r}")

    name = check_ros_name(options.check_session_name(session), "session")
    table = TopicTable.read(names)
    # Checked now, because the bridge would wait for a router at a wrong address forever.
    check_hosts(ros or ())
    running = RunningSession(name, reach.resolve(operates=False).require(BRIDGE))

    def open_graph(refusals: Refusals) -> Ros2Graph:
        """Joins the ROS 2 network as a node called trilat, in the session's namespace.

        Args:
            refusals: Counts the messages of ROS programs that the bridge rejects.
        """
        return Ros2Graph(
            refusals=refusals,
            routers=ros or [options.ROS_ROUTER],
            namespace=name,
            name="trilat",
            clock=SystemClock(),
            domain=domain,
            distro=distro,
        )

    with Interrupt() as interrupt:
        serve_ros2(
            running=running,
            open_graph=open_graph,
            rate_hz=rate,
            table=table,
            stopped=interrupt.is_requested,
            say=terminal.print_line,
            timeout_s=timeout,
            rviz=rviz,
        )
    if interrupt.is_requested():
        raise typer.Exit(interrupt.exit_code)
