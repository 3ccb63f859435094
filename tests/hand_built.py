"""Arms of one or two bodies whose mechanics can be derived by hand."""

from fractions import Fraction
from pathlib import Path

from spelgen.arm.arm import Body, Chain, Coordinate

UPRIGHT = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
SIDEWAYS = ((0, 0, 1), (1, 0, 0), (0, 1, 0))  # the joint's z axis is the parent's x axis


def coordinate(name="a", kind="revolute", **changes):
    """Return a coordinate with position limits of +-1 rad or m and no friction; keywords replace its fields."""
    known = {"lower": -1.0, "upper": 1.0, "effort": 10.0, "velocity": 10.0, "damping": 0.0, "friction": 0.0}
    return Coordinate(
        name=name, joint_type=kind, **({"continuous": False, "passive": False} | known | changes)
    )


def body(name="a", kind="revolute", **changes):
    """Return a body on the root: a point mass of 1 kg at the origin of its joint; keywords replace its fields."""
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
    """Return the ten inertial parameters of a point mass [kg] at x [m] on the x axis."""
    return (mass, mass * x, 0, 0, 0, 0, 0, mass * x * x, 0, mass * x * x)


def arm(coordinates, bodies, gravity=(0, 0, 0)):
    return Chain("hand_built", tuple(coordinates), tuple(bodies), gravity, diagnostics=(), locked=())


def slider(mass=2.0, **changes):
    """Return an arm with one prismatic joint: a mass [kg] on a horizontal rail, without gravity."""
    rail = body(kind="prismatic", rotation=SIDEWAYS, inertia=point(mass))
    return arm([coordinate(kind="prismatic", **changes)], [rail])


def pendulum(mass=1.5, length=0.7):
    """Return an arm with one turning joint: a point mass [kg] on a rod [m], with q its angle from the horizontal."""
    return arm([coordinate(continuous=True)], [body(inertia=point(mass, length))], gravity=(0, -9.81, 0))


LINK = """<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="0.2 0 0"/>
  <inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>
  <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="10" velocity="2"/>{more}</joint>"""


def coupled_urdf(path: Path) -> Path:
    """Write the URDF of two turning joints a and b, where b mimics a: b = 0.5 a - 0.1; return its path."""
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
