"""URDF texts of two small robots, and of their parts."""

BODY = (
    '<inertial><origin xyz="0.1 0 0"/><mass value="2"/>'
    '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/></inertial>'
)
LIMIT = '<limit lower="-1" upper="2" effort="30" velocity="4"/>'


def link(name: str, body: str = BODY) -> str:
    return f'<link name="{name}">{body}</link>'


def joint(
    name: str, parent: str, child: str, kind: str = "revolute", inside: str = LIMIT
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="0 0 0.5"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/>{inside}</joint>'
    )


def robot(*elements: str) -> str:
    return f'<robot name="r">{"".join(elements)}</robot>'


TWO = robot(
    link("base", ""),
    joint("one", "base", "upper"),
    link("upper"),
    joint("two", "upper", "lower"),
    link("lower"),
)
GRIPPER = robot(
    link("base", ""),
    joint("one", "base", "upper"),
    link("upper"),
    joint("mount", "upper", "camera", "fixed"),
    link("camera"),
    joint("two", "upper", "palm"),
    link("palm"),
    joint("left", "palm", "finger", "prismatic"),
    link("finger"),
    joint("right", "palm", "thumb", "prismatic", f'{LIMIT}<mimic joint="left"/>'),
    link("thumb"),
    joint("hand", "palm", "tcp", "fixed"),
    link("tcp", ""),
)
