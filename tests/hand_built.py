"""Arms of one or two bodies whose mechanics can be derived by hand."""

from fractions import Fraction
from pathlib import Path

from spelgen.arm.arm import Body, Chain, Coordinate

UPRIGHT = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
SIDEWAYS = ((0, 0, 1), (1, 0, 0), (0, 1, 0))  # the joint's z along the parent's x


def coordinate(name="a", kind="revolute", **changes):
    """A joint with limits of +-1 and no friction."""
    known = {"lower": -1.0, "upper": 1.0, "effort": 10.0, "velocity": 10.0, "damping": 0.0, "friction": 0.0}
    return Coordinate(
        name=name, joint_type=kind, **({"continuous": False, "passive": False} | known | changes)
    )


def body(name="a", kind="revolute", **changes):
    """A point of mass 1 in the origin of its joint, on the root."""
    known = {
        "parent": -1,
        "coordinate": 0,
        "multiplier": Fraction(1),
        "offset": 0.0,
        "rotation": UPRIGHT,
        "translation": (0, 0, 0),
        "inertia": point(1),
    }
    return Body(name=name, link=f"link of {name}", joint_type=kind, **(known | changes))


def point(mass, x=0.0):
    """The ten inertial parameters of a point mass on the x axis."""
    return (mass, mass * x, 0, 0, 0, 0, 0, mass * x * x, 0, mass * x * x)


def arm(coordinates, bodies, gravity=(0, 0, 0)):
    return Chain("hand_built", tuple(coordinates), tuple(bodies), gravity, diagnostics=(), locked=())


def slider(mass=2.0, **changes):
    """A mass on a rail, without gravity."""
    rail = body(kind="prismatic", rotation=SIDEWAYS, inertia=point(mass))
    return arm([coordinate(kind="prismatic", **changes)], [rail])


def pendulum(mass=1.5, length=0.7):
    """A point mass on a rod, at angle q from the horizontal."""
    return arm([coordinate(continuous=True)], [body(inertia=point(mass, length))], gravity=(0, -9.81, 0))


LINK = """<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="0.2 0 0"/>
  <inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>
  <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="10" velocity="2"/>{more}</joint>"""


def coupled_urdf(path: Path) -> Path:
    """Two revolute joints, the second of which follows the first: 0.5 q - 0.1."""
    parts = [
        '<robot name="coupled"><link name="base"/>',
        LINK.format(name="upper", mass=2),
        LINK.format(name="fore", mass=1),
        JOINT.format(name="a", kind="revolute", parent="base", child="upper", xyz="0 0 0", more=""),
        JOINT.format(
            name="b", kind="revolute", parent="upper", child="fore", xyz="0.4 0 0",
            more='<mimic joint="a" multiplier="0.5" offset="-0.1"/>',
        ),
        "</robot>",
    ]  # fmt: skip
    path.write_text("".join(parts))
    return path
