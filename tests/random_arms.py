"""Hypothesis draws arms as URDF text: serial chains of any joint types, with special and with general geometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

from hypothesis import strategies as st

Draw = Callable[[st.SearchStrategy], object]

RIGHT = tuple(repr(k * pi / 2) for k in (0, 0, 1, -1, 2))
HALF = tuple(repr(k * pi / 4) for k in (1, -1, 3))
# far enough from every multiple of pi/2 that sizes tell what is zero
GENERAL = tuple(
    f"{k / 100:g}" for k in range(-310, 311) if abs((k / 100 + pi / 4) % (pi / 2) - pi / 4) > 0.05
)
OFFSETS = ("0", "0", "0.1", "-0.1", "0.25")
STRAIGHT_AXES = ("0 0 1", "0 0 1", "0 0 -1", "0 1 0", "0 -1 0", "1 0 0", "-1 0 0")
SKEW_AXES = ("1 1 0", "0 -1 1", "1 2 3", "0.6 0 0.8")
TYPES = ("revolute", "revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class Follower:
    """q = multiplier * q_leader + offset, of the joint ``name``."""

    name: str
    leader: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class DrawnArm:
    """The text of a URDF, the joints of its chain, root first, and what follows them."""

    text: str
    joints: tuple[str, ...]
    followers: tuple[Follower, ...]


@dataclass(frozen=True)
class _Style:
    """What the numbers of one arm are drawn from."""

    angles: tuple[str, ...]
    offsets: st.SearchStrategy
    axes: tuple[str, ...]


_GENERAL_OFFSETS = st.integers(-500, 500).filter(lambda k: abs(k) > 20).map(lambda k: f"{k / 1000:g}")
STYLES = (
    _Style(RIGHT, st.sampled_from(OFFSETS), STRAIGHT_AXES),
    _Style(RIGHT + HALF, st.sampled_from(OFFSETS), STRAIGHT_AXES),
    _Style(RIGHT + HALF, st.sampled_from(OFFSETS), STRAIGHT_AXES + SKEW_AXES),
    _Style(GENERAL, _GENERAL_OFFSETS, STRAIGHT_AXES + SKEW_AXES),
    _Style(RIGHT + GENERAL[::60], st.sampled_from(OFFSETS) | _GENERAL_OFFSETS, STRAIGHT_AXES + SKEW_AXES),
)


@st.composite
def arms(draw: Draw) -> DrawnArm:
    """An arm of 2 to 6 joints, with fixed links between, a tilted base, a side branch and a mimic joint at times."""
    style = draw(st.sampled_from(STYLES))
    count = draw(st.integers(2, 6))
    names = tuple(f"j{k + 1}" for k in range(count))
    mimic_at = draw(st.sampled_from((None, None, *range(count))))
    mimic_in_chain = draw(st.booleans())
    parts, tip, followers = [_link(draw, style, "base")], "base", []
    for k, name in enumerate(names):
        if draw(st.integers(0, 4)) == 0:
            parts.append(_joint(draw, style, f"fixed{k}", "fixed", tip, f"plate{k}"))
            tip = f"plate{k}"
        parts.append(_joint(draw, style, name, draw(st.sampled_from(TYPES)), tip, f"link{k}"))
        tip = f"link{k}"
        if k == mimic_at:
            follower = _follower(draw, names[draw(st.integers(0, k))])
            followers.append(follower)
            kind = draw(st.sampled_from(TYPES))
            parts.append(_joint(draw, style, follower.name, kind, tip, "driven", _mimic(follower)))
            tip = "driven" if mimic_in_chain else tip
    if draw(st.integers(0, 3)) == 0:
        kind = draw(st.sampled_from((*TYPES, "fixed")))
        parts.append(_joint(draw, style, "side", kind, f"link{draw(st.integers(0, count - 1))}", "finger"))
    return DrawnArm(f'<robot name="drawn">\n{"".join(parts)}</robot>\n', names, tuple(followers))


def _follower(draw: Draw, leader: str) -> Follower:
    multiplier = draw(st.sampled_from((1.0, -1.0, 2.0, 0.5, -1.5)))
    return Follower("follower", leader, multiplier, draw(st.sampled_from((0.0, 0.0, pi / 2, 0.3))))


def _mimic(follower: Follower) -> str:
    return f'  <mimic joint="{follower.leader}" multiplier="{follower.multiplier!r}" offset="{follower.offset!r}"/>\n'


def _joint(draw: Draw, style: _Style, name: str, kind: str, parent: str, child: str, mimic: str = "") -> str:
    """A joint, and its child link."""
    axis = "" if kind == "fixed" else f'  <axis xyz="{draw(st.sampled_from(style.axes))}"/>\n'
    limit = (
        '  <limit lower="-3" upper="3" effort="10" velocity="2"/>\n'
        if kind in ("revolute", "prismatic")
        else ""
    )
    return (
        f'<joint name="{name}" type="{kind}">\n  <parent link="{parent}"/>\n  <child link="{child}"/>\n'
        f"{_origin(draw, style)}{axis}{limit}{mimic}</joint>\n{_link(draw, style, child)}"
    )


def _origin(draw: Draw, style: _Style) -> str:
    xyz = " ".join(draw(style.offsets) for _ in range(3))
    rpy = " ".join(draw(st.sampled_from(style.angles)) for _ in range(3))
    return f'  <origin xyz="{xyz}" rpy="{rpy}"/>\n'


def _link(draw: Draw, style: _Style, name: str) -> str:
    """A link with the inertia of a box; at times one that lies straight in the link's frame, or on its axis."""
    a, b, c = (draw(st.integers(2, 60)) for _ in range(3))  # second moments of mass [1e-3 kg m2]
    tensor = (
        f'ixx="{(b + c) / 1000:g}" iyy="{(a + c) / 1000:g}" izz="{(a + b) / 1000:g}" ixy="0" ixz="0" iyz="0"'
    )
    mass = f'<mass value="{draw(st.integers(1, 80)) / 10:g}"/>'
    return f'<link name="{name}">\n <inertial>\n{_origin(draw, style)}  {mass}<inertia {tensor}/>\n </inertial>\n</link>\n'
