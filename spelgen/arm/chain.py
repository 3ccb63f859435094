"""Robot -> the joints that are the arm's coordinates, and what the mimic joints follow."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from spelgen.arm.rational import bounded, exact
from spelgen.errors import ArmError, Diagnostic, Severity, suggestion
from spelgen.urdf.robot import Joint, Robot

_GRIPPER = re.compile(r"gripper|finger|thumb|knuckle|(?:^|[^a-z])jaws?(?:[^a-z]|$)", re.IGNORECASE)
_CHOOSE = "choose one with --tip LINK or --joints A,B,..."


@dataclass(frozen=True)
class Chain:
    """The chosen joints, root first, and what to tell about the choice."""

    joints: tuple[Joint, ...]
    diagnostics: tuple[Diagnostic, ...] = ()


@dataclass(frozen=True)
class Follow:
    """q = multiplier * q_leader + offset, with a leader that follows nothing."""

    leader: Joint
    multiplier: Fraction
    offset: Fraction


def choose_chain(robot: Robot, joints: Sequence[str] | None, tip: str | None) -> Chain:
    """Return the joints named, those on the way to the link ``tip``, or the longest serial chain.

    In the last case joints named after a gripper or finger at the end of the chain are left out. Raises
    ``ArmError``.
    """
    if joints is not None and tip is not None:
        raise ArmError("both joints and a tip", file=robot.told_as, expected="one of the two")
    if joints is not None:
        chain = Chain(_named(robot, joints))
    elif tip is not None:
        chain = Chain(_up_to(robot, tip))
    else:
        chain = _longest(robot)
    if not chain.joints:
        raise ArmError(
            "no joint that moves by itself", file=robot.told_as, expected="a serial chain of joints"
        )
    _refuse_free_joints(robot, chain.joints[-1])
    return chain


def follows(robot: Robot) -> dict[str, Follow]:
    """Return what each joint follows, through any number of mimic joints; itself where it follows none."""
    found: dict[str, Follow] = {}
    for joint in robot.joints:
        waiting = []
        while joint.name not in found and joint.mimic is not None:
            waiting.append((joint.name, joint.mimic))
            joint = robot.joint[joint.mimic.joint]
        followed = found.setdefault(joint.name, Follow(joint, Fraction(1), Fraction(0)))
        for name, mimic in reversed(waiting):
            multiplier = exact(mimic.multiplier)
            offset = multiplier * followed.offset + exact(mimic.offset)
            followed = Follow(followed.leader, bounded(multiplier * followed.multiplier), bounded(offset))
            found[name] = followed
    return found


def _is_free(joint: Joint) -> bool:
    return joint.moves and joint.mimic is None


def _refuse_free_joints(robot: Robot, last: Joint) -> None:
    for joint in robot.path_to(last.parent):
        if joint.type in ("floating", "planar"):
            raise ArmError(
                f"a {joint.type} joint on the way to the joint {last.name!r}",
                file=robot.told_as,
                line=joint.line,
                element=f"joint {joint.name!r}",
                expected="revolute, continuous, prismatic and fixed joints there",
                do="an arm on a moving base is out of scope: make the joint fixed, or take it out",
            )


def _named(robot: Robot, names: Sequence[str]) -> tuple[Joint, ...]:
    chosen = [_usable(robot, name) for name in names]
    repeated = [name for name in names if list(names).count(name) > 1]
    if repeated:
        raise ArmError(f"the joint {repeated[0]!r} twice", file=robot.told_as, expected="each joint once")
    if not chosen:
        return ()
    paths = {joint.name: robot.path_to(joint.child) for joint in chosen}
    deepest = max(chosen, key=lambda joint: len(paths[joint.name]))
    ordered = tuple(joint for joint in paths[deepest.name] if joint.name in paths)
    for joint in chosen:
        if joint not in ordered:
            raise ArmError(
                f"the joints {joint.name!r} and {deepest.name!r}, which lie on different branches",
                file=robot.told_as,
                line=joint.line,
                expected="joints on one path from the root",
            )
    if list(ordered) != chosen:
        told = ",".join(joint.name for joint in ordered)
        got = f"the joints in the order {','.join(names)}"
        raise ArmError(
            got, file=robot.told_as, expected="the order from the root to the tip", do=f"use {told}"
        )
    return ordered


def _usable(robot: Robot, name: str) -> Joint:
    joint = robot.joint.get(name)
    if joint is None:
        names = [each.name for each in robot.joints if _is_free(each)]
        raise ArmError(f"no joint is named {name!r}", file=robot.told_as, do=suggestion(name, names))
    where = f"joint {name!r}"
    if not joint.moves:
        got = f"a {joint.type} joint"
        expected = "a revolute, continuous or prismatic joint"
        raise ArmError(got, file=robot.told_as, line=joint.line, element=where, expected=expected)
    if joint.mimic is not None:
        do = f"name {follows(robot)[name].leader.name!r} instead: what follows it moves with it"
        raise ArmError(
            "a mimic joint", file=robot.told_as, line=joint.line, element=where, expected="its leader", do=do
        )
    return joint


def _up_to(robot: Robot, tip: str) -> tuple[Joint, ...]:
    if tip not in robot.link:
        raise ArmError(f"no link is named {tip!r}", file=robot.told_as, do=suggestion(tip, robot.link))
    return tuple(joint for joint in robot.path_to(tip) if _is_free(joint))


def _longest(robot: Robot) -> Chain:
    """The longest chain; several of one length are told apart by what is certain, or are an error."""
    chains = _chains(robot)
    length = max((len(chain) for chain in chains), default=0)
    longest = [chain for chain in chains if len(chain) == length]
    if len(longest) < 2:
        return Chain(longest[0] if longest else ())
    if _is_parallel_gripper(longest):
        jaws = ", ".join(repr(chain[-1].name) for chain in longest)
        message = f"{jaws} slide side by side at the end of the chain: taken as a gripper's and locked"
        return Chain(longest[0][:-1], (_told(longest[0][-1], "info", message),))
    driven = [chain for chain in longest if all(joint.effort != 0 for joint in chain)]
    if len(driven) == 1:
        message = (
            f"{len(longest)} chains of {length} joints: the only one without a joint of effort 0 is taken"
        )
        return Chain(driven[0], (_told(driven[0][-1], "warning", message),))
    raise _ambiguous(robot, longest)


def _told(joint: Joint, severity: Severity, message: str) -> Diagnostic:
    return Diagnostic(severity, "ambiguous-chain", f"joint {joint.name!r}", joint.line, message)


def _chains(robot: Robot) -> list[tuple[Joint, ...]]:
    """The distinct chains from the root to a tip, without what belongs to a gripper by its name."""
    chains: dict[tuple[str, ...], tuple[Joint, ...]] = {}
    for link in robot.links:
        if not robot.joints_below[link.name]:
            chain = _without_gripper(tuple(joint for joint in robot.path_to(link.name) if _is_free(joint)))
            chains.setdefault(tuple(joint.name for joint in chain), chain)
    return list(chains.values())


def _without_gripper(chain: tuple[Joint, ...]) -> tuple[Joint, ...]:
    end = len(chain)
    while end and _GRIPPER.search(chain[end - 1].name):
        end -= 1
    # a chain of nothing but fingers is a finger robot, and the finger is the arm
    return chain[:end] if end else chain


def _is_parallel_gripper(chains: Sequence[tuple[Joint, ...]]) -> bool:
    """Chains that differ in a last sliding joint only, all from one link."""
    lasts = [chain[-1] for chain in chains]
    same_start = all(chain[:-1] == chains[0][:-1] for chain in chains) and len(chains[0]) > 1
    return same_start and all(last.type == "prismatic" and last.parent == lasts[0].parent for last in lasts)


def _ambiguous(robot: Robot, chains: Sequence[tuple[Joint, ...]]) -> ArmError:
    listed = " and ".join(
        f"one to the link {chain[-1].child!r} ({chain[0].name} ... {chain[-1].name})" for chain in chains[:4]
    )
    more = f" and {len(chains) - 4} more" if len(chains) > 4 else ""
    got = f"{len(chains)} chains of {len(chains[0])} joints: {listed}{more}"
    return ArmError(got, file=robot.told_as, expected="one longest chain", do=_CHOOSE)
