"""Users' own arms as URDF texts, for the gains that an arm tolerates."""

from collections.abc import Sequence
from typing import NamedTuple


class Piece(NamedTuple):
    """A joint and the link that the joint moves: a rod along x, of mass kg and length m."""

    axis: str = "0 0 1"
    mass: float = 1.0
    length: float = 0.5
    kind: str = "revolute"
    offset: str = ""
    """Where the joint is on the link before; "": at its end."""


def write_arm(pieces: Sequence[Piece], payload: str = "") -> str:
    """Returns the URDF of a chain; `payload` is the text of a body at its end."""
    parts = ['<robot name="odd"><link name="base"/>']
    parent = "base"
    end = "0 0 0"
    for n, piece in enumerate(pieces, 1):
        across = piece.mass * piece.length**2 / 12.0  # inertia of a rod about its middle
        limits = "-0.4 0.4" if piece.kind == "prismatic" else "-2 2"
        low, high = limits.split()
        parts.append(f"""
<link name="l{n}"><inertial><origin xyz="{0.5 * piece.length} 0 0"/><mass value="{piece.mass}"/>
<inertia ixx="{0.2 * across}" ixy="0" ixz="0" iyy="{across}" iyz="0" izz="{across}"/></inertial></link>
<joint name="j{n}" type="{piece.kind}"><parent link="{parent}"/><child link="l{n}"/>
<origin xyz="{piece.offset or end}"/><axis xyz="{piece.axis}"/>
<limit lower="{low}" upper="{high}" effort="50" velocity="5"/>
<dynamics damping="0.3" friction="0.2"/></joint>""")
        parent = f"l{n}"
        end = f"{piece.length} 0 0"
    if payload:
        parts.append(f'<link name="tool">{payload}</link><joint name="fixed" type="fixed">')
        parts.append(
            f'<parent link="{parent}"/><child link="tool"/><origin xyz="{end}"/></joint>'
        )
    return "\n".join([*parts, "</robot>"])


def body(mass: float, place: str) -> str:
    """Returns the text of a ball of 5 cm."""
    inertia = 0.4 * mass * 0.05**2
    return (
        f'<inertial><origin xyz="{place}"/><mass value="{mass}"/><inertia ixx="{inertia}" ixy="0" ixz="0" '
        f'iyy="{inertia}" iyz="0" izz="{inertia}"/></inertial>'
    )


SHOULDER = Piece("0 0 1", 3.0)
ELBOW = Piece("0 1 0", 2.0, 0.4)
SLIDE = Piece("1 0 0", 2.0, 0.3, "prismatic")
ODD_ARMS = {
    "one joint": write_arm([SHOULDER]),
    "slide": write_arm([SLIDE]),
    "slide and elbow": write_arm([SLIDE, ELBOW]),
    "light wrist": write_arm(
        [SHOULDER, ELBOW, Piece("1 0 0", 0.02, 0.05), Piece("0 1 0", 0.01, 0.03)]
    ),
    "payload": write_arm([SHOULDER, ELBOW], body(20.0, "0 0 0")),
    "off-axis tool": write_arm(
        [SHOULDER, ELBOW, Piece("1 0 0", 0.3, 0.1)], body(0.5, "0 0.2 0.1")
    ),
}
"""By name, arms that are unlike those of makers."""
