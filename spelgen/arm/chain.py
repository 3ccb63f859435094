"""Choose the serial chain of joints of a `Robot` that are the coordinates of an arm; find leaders of mimic joints."""

import math
import re
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import NamedTuple

from spelgen.arm.rational import bounded, exact
from spelgen.errors import ArmError, Diagnostic, Severity, suggestion
from spelgen.labels import counted
from spelgen.urdf.robot import Robot, UrdfJoint

# Words in names of gripper joints. The arm ends before the gripper.
_GRIPPER = re.compile(r"gripper|finger|thumb|knuckle|(?:^|[^a-z])jaws?(?:[^a-z]|$)", re.IGNORECASE)

_LARGEST_JAW = 0.1  # [m] a prismatic last joint with at most this travel probably opens a gripper


class ChainChoice(NamedTuple):
    """The joints of the chain, from the root to the tip, and diagnostics of their selection."""

    joints: tuple[UrdfJoint, ...]
    diagnostics: tuple[Diagnostic, ...] = ()

    @property
    def names(self) -> list[str]:
        """Names of the joints, as in the URDF."""
        return [joint.name for joint in self.joints]


class Leader(NamedTuple):
    """Joint that a mimic joint follows by q = multiplier * q_leader + offset [rad, m]; the leader has no <mimic>."""

    leader: UrdfJoint
    multiplier: Fraction
    offset: Fraction


def choose_chain(robot: Robot, joints: Sequence[str] | None, tip: str | None) -> ChainChoice:
    """Return the chain of the joints named ``joints``, the chain to the link ``tip``, or the longest serial chain.

    Joints with the name of a gripper or finger at the end of the longest chain are excluded. Raises ArmError if the
    joints do not form a serial chain, or if the choice is ambiguous.
    """
    if joints is not None and tip is not None:
        raise ArmError("both joints and a tip", file=robot.source, expected="one of the two")
    if joints is not None:
        chain = ChainChoice(_named(robot, joints))
    elif tip is not None:
        if tip not in robot.link:
            raise ArmError(f"no link is named {tip!r}", file=robot.source, do=suggestion(tip, robot.link))
        chain = ChainChoice(_independent(robot.path_to(tip)))
    else:
        chain = _longest(robot)
    if not chain.joints:
        expected = "a serial chain of joints"
        raise ArmError("no joint that moves independently", file=robot.source, expected=expected)
    # A mobile base has a floating joint between the root and the arm. This is not an error: the arm is described
    # relative to the base.
    below = robot.path_to(chain.joints[0].parent)
    for joint in robot.path_to(chain.joints[-1].parent):
        if joint.type in ("floating", "planar") and joint not in below:
            raise ArmError(
                f"a {joint.type} joint on the way to the joint {chain.joints[-1].name!r}", file=robot.source,
                line=joint.line, element=f"joint {joint.name!r}",
                expected="revolute, continuous, prismatic and fixed joints there",
                do="make the joint fixed, or take it out",
            )  # fmt: skip
    return chain


def leaders(robot: Robot) -> dict[str, Leader]:
    """Return {name of a joint: its leader} for all joints; a joint without <mimic> is its own leader.

    The leader of a joint that mimics a mimic joint is the joint without <mimic> at the end of this sequence.
    """
    result: dict[str, Leader] = {}
    for joint in robot.joints:
        followers = []
        leader = joint
        # Leaders are found by a loop and not by recursion, because a file may have any number of mimic joints in
        # sequence.
        while leader.name not in result and leader.mimic is not None:
            followers.append((leader.name, leader.mimic))
            leader = robot.joint[leader.mimic.joint]
        follow = result.setdefault(leader.name, Leader(leader, Fraction(1), Fraction(0)))
        # The joint that mimics the leader directly is processed first, because multiplier and offset of each mimic
        # joint depend on the values of the joint that it mimics.
        for name, mimic in reversed(followers):
            multiplier = exact(mimic.multiplier)
            offset = multiplier * follow.offset + exact(mimic.offset)
            follow = Leader(follow.leader, bounded(multiplier * follow.multiplier), bounded(offset))
            result[name] = follow
    return result


def _moves_by_itself(joint: UrdfJoint) -> bool:
    return joint.moves and joint.mimic is None


def _independent(joints: Iterable[UrdfJoint]) -> tuple[UrdfJoint, ...]:
    return tuple(filter(_moves_by_itself, joints))


def _named(robot: Robot, names: Sequence[str]) -> tuple[UrdfJoint, ...]:
    """Return the joints named by the user. Raises ArmError unless all are on one path, in order from root to tip."""
    chosen = [_usable(robot, name) for name in names]
    for name in names:
        if list(names).count(name) > 1:
            raise ArmError(f"the joint {name!r} twice", file=robot.source, expected="each joint once")
    if not chosen:
        return ()
    # The path to the chosen joint that is farthest from the root contains all other chosen joints, unless they are on
    # another branch.
    deepest = max(chosen, key=lambda joint: len(robot.path_to(joint.child)))
    ordered = tuple(joint for joint in robot.path_to(deepest.child) if joint in chosen)
    for joint in chosen:
        if joint not in ordered:
            got = f"the joints {joint.name!r} and {deepest.name!r}, which lie on different branches"
            raise ArmError(
                got, file=robot.source, line=joint.line, expected="joints on one path from the root"
            )
    # A wrong order of the chosen joints is an error and is not corrected, because users expect columns of logs in the
    # order of `names`.
    if list(ordered) != chosen:
        got, do = f"the joints in the order {','.join(names)}", f"use {','.join(x.name for x in ordered)}"
        raise ArmError(got, file=robot.source, expected="the order from the root to the tip", do=do)
    return ordered


def _usable(robot: Robot, name: str) -> UrdfJoint:
    """Return a joint that the user has chosen. Raises ArmError if it is unknown, mimic, fixed, floating or planar."""
    joint = robot.joint.get(name)
    if joint is None:
        names = [joint.name for joint in _independent(robot.joints)]
        raise ArmError(f"no joint is named {name!r}", file=robot.source, do=suggestion(name, names))
    if _moves_by_itself(joint):
        return joint
    got, expected, do = f"a {joint.type} joint", "a revolute, continuous or prismatic joint", None
    if joint.moves:
        got, expected = "a mimic joint", "its leader"
        do = f"name {leaders(robot)[name].leader.name!r} instead: its mimic joints move with it"
    element = f"joint {name!r}"
    raise ArmError(got, file=robot.source, line=joint.line, element=element, expected=expected, do=do)


def _longest(robot: Robot) -> ChainChoice:
    """Return the longest chain of joints from the root to a tip, without the joints of grippers.

    1. If the last joint is a jaw of a gripper, it is omitted. Candidates for jaws are the last joints of all longest
       chains, and the joints that mimic the last joint. They are jaws if there are at least two, all prismatic and with
       the same parent link; otherwise no joint is omitted.
    2. If there are no jaws and several chains are the longest, the chain with effort limits of all joints is returned.
       Raises ArmError if no chain, or more than one, has these limits.
    """
    # The end of each branch may be the tip. The longest chain is the arm, because hands, tools and sensors are on
    # shorter branches.
    tips = [link.name for link in robot.links if not robot.joints_below[link.name]]
    # Duplicate chains are removed: several fingers without joints may be at the end of the same chain.
    chains = dict.fromkeys(_without_gripper(_independent(robot.path_to(tip))) for tip in tips)
    length = max(map(len, chains), default=0)
    longest = [chain for chain in chains if len(chain) == length]
    if not length:
        return ChainChoice(())
    first, last = longest[0], longest[0][-1]
    by_leader = leaders(robot)
    jaws = [chain[-1] for chain in longest]
    jaws += [joint for joint in robot.joints if joint.mimic and by_leader[joint.name].leader == last]
    is_pair = len(jaws) > 1 and {(x.type, x.parent) for x in jaws} == {(last.type, last.parent)}
    if first[:-1] and is_pair and last.type == "prismatic":
        names = ", ".join(repr(joint.name) for joint in jaws)
        message = f"{names} slide side by side at the end of the chain: taken as a gripper's and locked"
        return ChainChoice(first[:-1], _remark(last, "info", message))
    if len(longest) == 1:
        return ChainChoice(first, _possible_gripper(robot, last, len(jaws) > 1))
    # A joint without effort limit (absent, or 0 in the file) probably has no motor: the chain without such joints is
    # the arm.
    driven = [chain for chain in longest if all(joint.effort is not None for joint in chain)]
    got = f"{len(longest)} chains of {counted(length, 'joint')}: "
    if len(driven) == 1:
        message = f"{got}the only one with effort limits of all joints is taken"
        return ChainChoice(driven[0], _remark(driven[0][-1], "warning", message))
    listed = [f"one to the link {x[-1].child!r} ({x[0].name} ... {x[-1].name})" for x in longest[:4]]
    if len(longest) > 4:
        listed.append(f"{len(longest) - 4} more")
    got += " and ".join(listed)
    do = "choose one with --tip LINK or --joints A,B,..., or write tip or moving_joints into the settings"
    raise ArmError(got, file=robot.source, expected="one longest chain", do=do)


def _possible_gripper(robot: Robot, last: UrdfJoint, is_mimicked: bool) -> tuple[Diagnostic, ...]:
    """Return a remark if the last joint of the chain may open a gripper; otherwise no remark.

    The joint may open a gripper in three cases: it is prismatic and moves by at most 0.1 m; other jaws or finger joints
    follow it (``is_mimicked``); or its child link has the name of a gripper. The last criterion is used only if no
    joint of the robot has the name of a gripper, since such joints are excluded from the chain already. A joint with a
    range of more than half a turn causes no remark: no jaw opens that far, so it rotates the whole gripper.
    """
    lower, upper = last.limits or (0.0, 0.0)
    travel = upper - lower
    is_named = bool(_GRIPPER.search(last.child)) and not any(map(_GRIPPER.search, robot.joint))
    is_jaw = is_mimicked or (last.type == "prismatic" and 0 < travel <= _LARGEST_JAW)
    if travel > math.pi or not (is_jaw or is_named):
        return ()
    message = (
        f"moves the link {last.child!r}, as the last joint of the arm: if it opens a gripper, exclude it by "
        f"'--tip {last.parent}', or by 'tip' in the settings"
    )
    return _remark(last, "info", message)


def _remark(joint: UrdfJoint, severity: Severity, message: str) -> tuple[Diagnostic, ...]:
    return (Diagnostic(severity, "ambiguous-chain", f"joint {joint.name!r}", joint.line, message),)


def _without_gripper(chain: tuple[UrdfJoint, ...]) -> tuple[UrdfJoint, ...]:
    end = len(chain)
    while end and _GRIPPER.search(chain[end - 1].name):
        end -= 1
    # If all joints of a chain have names of fingers, the robot is a single finger, which is then the arm.
    return chain[:end] or chain
