"""Random arms as URDF text: chains of all joint types, with special and with general geometry."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from random import Random
from typing import Any

from hypothesis import strategies as st

RIGHT = tuple(repr(k * pi / 2) for k in (0, 0, 1, -1, 2))
HALF = tuple(repr(k * pi / 4) for k in (1, -1, 3))
# angles that differ by at least 0.05 rad from multiples of pi/2, so that zeros are recognised by magnitude
GENERAL = tuple(
    f"{k / 100:g}" for k in range(-310, 311) if abs((k / 100 + pi / 4) % (pi / 2) - pi / 4) > 0.05
)
OFFSETS = ("0", "0", "0.1", "-0.1", "0.25")
STRAIGHT_AXES = ("0 0 1", "0 0 1", "0 0 -1", "0 1 0", "0 -1 0", "1 0 0", "-1 0 0")
SKEW_AXES = ("1 1 0", "0 -1 1", "1 2 3", "0.6 0 0.8")
TYPES = ("revolute", "revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class Follower:
    """A mimic joint ``name``: q = multiplier * q_leader + offset, with the position q_leader of joint ``leader``."""

    name: str
    leader: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class DrawnArm:
    """A random URDF: its text, the joints of its chain from the root, and its mimic joints."""

    text: str
    joints: tuple[str, ...]
    followers: tuple[Follower, ...]


@dataclass(frozen=True)
class _Style:
    """Choice of numbers for the URDF of one arm: angles, offsets and axes of joints.

    The style "right angles" has prismatic joints along x, y or z only. Skew axes may enclose an angle such as
    60 degrees, for which there is no rational rotation matrix: spelgen represents it with an error of 1e-11.
    """

    angles: tuple[str, ...]
    offsets: tuple[str, ...]
    axes: tuple[str, ...]


_GENERAL_OFFSETS = tuple(f"{k / 1000:g}" for k in range(-500, 501) if abs(k) > 20)
STYLES = {
    "right angles": _Style(RIGHT, OFFSETS, STRAIGHT_AXES),
    "right and half angles": _Style(RIGHT + HALF, OFFSETS, STRAIGHT_AXES),
    "skew axes": _Style(RIGHT, OFFSETS, STRAIGHT_AXES + SKEW_AXES),
    "mixed": _Style(RIGHT * 3 + GENERAL, OFFSETS + _GENERAL_OFFSETS[::200], STRAIGHT_AXES + SKEW_AXES),
    "general": _Style(GENERAL, _GENERAL_OFFSETS, STRAIGHT_AXES + SKEW_AXES),
}


@st.composite
def arms(draw: Any) -> DrawnArm:
    """Draw an arm of 2 to 6 joints; some arms have plates (links on fixed joints), a side branch, or a mimic joint.

    Hypothesis draws the joint types, these options, and the seed of all random lengths, angles, axes and inertias.
    """
    style = STYLES[draw(st.sampled_from(tuple(STYLES)))]
    kinds = draw(st.lists(st.sampled_from(TYPES), min_size=2, max_size=6))
    plates = draw(st.sets(st.integers(0, len(kinds) - 1), max_size=2))
    follows = draw(st.sampled_from(("nothing", "nothing", "in the chain", "on a branch")))
    side = draw(st.sampled_from((None, None, "fixed", *TYPES)))
    random = draw(st.randoms(use_true_random=True))
    return _drawn(_Writer(style, random), kinds, plates, follows, side)


def _drawn(write: _Writer, kinds: list[str], plates: set[int], follows: str, side: str | None) -> DrawnArm:
    names = tuple(f"j{k + 1}" for k in range(len(kinds)))
    parts, tip, follower = [write.link("base")], "base", None
    follower_at = write.random.randrange(len(kinds)) if follows != "nothing" else None
    for k, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        if k in plates:
            parts.append(write.joint(f"fixed{k}", "fixed", tip, f"plate{k}"))
            tip = f"plate{k}"
        parts.append(write.joint(name, kind, tip, f"link{k}"))
        tip = f"link{k}"
        if k == follower_at:
            follower = write.follower(names[: k + 1])
            parts.append(write.joint(follower.name, write.random.choice(TYPES), tip, "driven", follower))
            tip = "driven" if follows == "in the chain" else tip
    if side is not None:
        parts.append(write.joint("side", side, f"link{write.random.randrange(len(kinds))}", "finger"))
    text = f'<robot name="drawn">\n{"".join(parts)}</robot>\n'
    return DrawnArm(text, names, () if follower is None else (follower,))


@dataclass(frozen=True)
class _Writer:
    """Writer of URDF elements with random numbers; ``style`` has the angles, offsets and axes to choose from."""

    style: _Style
    random: Random

    def joint(self, name: str, kind: str, parent: str, child: str, follower: Follower | None = None) -> str:
        """Return the elements of a joint with random origin and axis, and of its child link."""
        lines = [f'<parent link="{parent}"/>', f'<child link="{child}"/>', self.origin()]
        if kind != "fixed":
            axes = STRAIGHT_AXES if kind == "prismatic" and self.style.angles is RIGHT else self.style.axes
            lines.append(f'<axis xyz="{self.random.choice(axes)}"/>')
        if kind in ("revolute", "prismatic"):
            lines.append('<limit lower="-3" upper="3" effort="10" velocity="2"/>')
        if follower is not None:
            rule = f'multiplier="{follower.multiplier!r}" offset="{follower.offset!r}"'
            lines.append(f'<mimic joint="{follower.leader}" {rule}/>')
        return _element(f'joint name="{name}" type="{kind}"', lines) + self.link(child)

    def link(self, name: str) -> str:
        """Return the element of a link with the inertia of a box at a random place."""
        # second moments of mass [1e-3 kg m2]; sums of two of them are the principal moments of a body
        a, b, c = (self.random.randint(2, 60) for _ in range(3))
        tensor = f'ixx="{(b + c) / 1000:g}" iyy="{(a + c) / 1000:g}" izz="{(a + b) / 1000:g}"'
        mass = f'<mass value="{self.random.randint(1, 80) / 10:g}"/>'
        lines = [self.origin(), mass, f'<inertia {tensor} ixy="0" ixz="0" iyz="0"/>']
        return f'<link name="{name}">\n{_element("inertial", lines)}</link>\n'

    def origin(self) -> str:
        """Return an <origin> whose xyz and rpy are random choices from the offsets [m] and angles [rad] of `style`."""
        xyz = " ".join(self.random.choice(self.style.offsets) for _ in range(3))
        rpy = " ".join(self.random.choice(self.style.angles) for _ in range(3))
        return f'<origin xyz="{xyz}" rpy="{rpy}"/>'

    def follower(self, leaders: tuple[str, ...]) -> Follower:
        """Return a mimic joint of one of the leaders, with a random multiplier and offset."""
        multiplier = self.random.choice((1.0, -1.0, 2.0, 0.5, -1.5))
        offset = self.random.choice((0.0, 0.0, pi / 2, 0.3))
        return Follower("follower", self.random.choice(leaders), multiplier, offset)


def _element(start: str, lines: list[str]) -> str:
    return f"<{start}>\n" + "".join(f"  {line}\n" for line in lines) + f"</{start.split()[0]}>\n"
