"""The file once more, read by yourdfpy: axes, origins and masses of every moving body beside the Arm's.

Errors in reading show here that no check of the derivation could see: it starts from the Arm.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from math import pi
from typing import Any

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.certificate.verification import Check, Verdict, size_told
from spelgen.urdf.robot import Joint, Link, Robot

_ROUNDING = 1e-9
"""What composed rotations (1e-11 each) and dropped offsets (below 1e-9 m) may add up to, per joint."""
_AXIS_ROUNDING = 1.5e-3  # two components below 1e-3 of a unit axis
_STEPS = (pi / 2, pi / 12, pi / 8, pi / 5)

_Roundings = dict[str, str]
"""What the arm's diagnostics tell as rounded, by place in the file."""


@dataclass(frozen=True)
class _Load:
    """What hangs on one body, in world axes about its origin, with the sizes that its errors are measured by.

    mass [kg], first moment (3,) [kg m], tensor (3, 3) [kg m2]; ``sizes`` are those of the three if nothing
    cancelled.
    """

    mass: float
    moment: np.ndarray
    tensor: np.ndarray
    sizes: tuple[float, float, float]


@dataclass(frozen=True)
class _Reading:
    """World poses (4, 4) of every body's link at one configuration ``q``, and what each body carries."""

    q: np.ndarray
    poses: list[np.ndarray]
    loads: list[_Load]


def urdf_cross_check(robot: Robot, arm: Arm, *, samples: int = 6, seed: int = 0) -> tuple[Check, ...]:
    """Compare ``arm`` with yourdfpy's reading of the same bytes at random configurations.

    Where nothing was rounded the two agree to rounding; where something was, within the roundings that the
    arm's diagnostics tell.
    """
    try:
        readings = list(_yourdfpy_readings(robot, arm, samples, seed))
    except Exception as problem:  # another program's failure proves nothing about ours
        told = " ".join(str(problem).split())[:120]
        found = f"yourdfpy cannot say ({type(problem).__name__}: {told})"
        return (Check("reading of the file", "the moving bodies", found, "undecided"),)
    rounded: _Roundings = {}
    for each in arm.diagnostics:
        if each.code.startswith("snapped-"):
            rounded[each.where] = f"{rounded.get(each.where, '')}; {each.message}"
    checks = [_frames_agree(robot, arm, readings, rounded)]
    if any(body.inertia is not None for body in arm.bodies):
        checks.append(_loads_agree(robot, arm, readings[0], rounded))
    return tuple(checks)


def _yourdfpy_readings(robot: Robot, arm: Arm, samples: int, seed: int) -> Iterator[_Reading]:
    data = robot.path.read_bytes()
    if hashlib.sha256(data).hexdigest() != robot.digest:
        raise ValueError("the file has changed since it was read")
    model = _yourdfpy_model(data)
    rng = np.random.default_rng(seed)
    for _ in range(samples):
        q = np.array([rng.uniform(-1, 1) * (pi if c.kind == "revolute" else 0.5) for c in arm.coordinates])
        model.update_cfg({c.name: float(value) for c, value in zip(arm.coordinates, q, strict=True)})
        poses = [model.get_transform(robot.joint[body.name].child, robot.root) for body in arm.bodies]
        yield _Reading(q, poses, [_load(robot, arm, model, body.name) for body in arm.bodies])


def _yourdfpy_model(data: bytes) -> Any:
    import yourdfpy  # slow to import

    logger = logging.getLogger("yourdfpy")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # it warns of what read_urdf has told already
    try:
        parsed = yourdfpy.URDF.load(BytesIO(data), build_scene_graph=False, load_meshes=False).robot
        followers = {joint.name for joint in parsed.joints if joint.mimic is not None}
        for joint in parsed.joints:
            if joint.mimic is not None and joint.mimic.joint in followers:
                raise ValueError("a mimic joint that follows a mimic joint")
            if joint.axis is not None:
                # a prismatic joint would move by the axis as it is written, however long
                joint.axis = joint.axis / (np.linalg.norm(joint.axis) or 1.0)
        for link in parsed.links:
            link.visuals, link.collisions = [], []
        return yourdfpy.URDF(parsed, build_scene_graph=True, load_meshes=False)
    finally:
        logger.setLevel(level)


def _load(robot: Robot, arm: Arm, model: Any, joint: str) -> _Load:
    """The sum of yourdfpy's inertials on the links that move with ``joint``."""
    pose = model.get_transform(robot.joint[joint].child, robot.root)
    mass, moment, tensor, sizes = 0.0, np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    for name in _carried(robot, arm, joint):
        inertial = model.link_map[name].inertial
        if inertial is None or inertial.mass is None:
            continue
        frame = model.get_transform(name, robot.root)
        frame = frame if inertial.origin is None else frame @ inertial.origin
        own = np.zeros((3, 3)) if inertial.inertia is None else inertial.inertia
        lever = frame[:3, 3] - pose[:3, 3]
        mass += inertial.mass
        moment += inertial.mass * lever
        tensor += frame[:3, :3] @ own @ frame[:3, :3].T
        tensor += inertial.mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))
        reach = sum(np.linalg.norm(each.xyz) for each in _between(robot, joint, name))
        reach += np.linalg.norm(lever)
        weight = abs(inertial.mass)
        sizes += (weight, weight * reach, weight * reach**2 + np.linalg.norm(own))
    return _Load(mass, moment, tensor, (sizes[0], sizes[1], sizes[2]))


def _carried(robot: Robot, arm: Arm, joint: str) -> list[str]:
    """The links that move with ``joint`` and with none of the other moving joints behind it."""
    moving = {body.name for body in arm.bodies}
    links, waiting = [], [robot.joint[joint].child]
    while waiting:
        links.append(waiting.pop())
        waiting += [each.child for each in robot.joints_below[links[-1]] if each.name not in moving]
    return links


def _between(robot: Robot, joint: str, link: str) -> tuple[Joint, ...]:
    """The joints from behind ``joint`` to ``link``, all of them held."""
    return robot.path_to(link)[len(robot.path_to(robot.joint[joint].child)) :]


def _frames(arm: Arm, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """World rotation (3, 3) and origin (3,) of every body at ``q`` (n,), from the Arm's exact poses."""
    frames: list[tuple[np.ndarray, np.ndarray]] = []
    for body in arm.bodies:
        rotation, origin = (np.eye(3), np.zeros(3)) if body.parent < 0 else frames[body.parent]
        origin = origin + rotation @ np.array(body.translation, dtype=float)
        rotation = rotation @ np.array(body.rotation, dtype=float)
        value = float(body.multiplier) * q[body.coordinate] + body.offset
        if body.kind == "prismatic":
            origin = origin + rotation[:, 2] * value
        else:
            c, s = np.cos(value), np.sin(value)
            rotation = rotation @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        frames.append((rotation, origin))
    return frames


def _frames_agree(robot: Robot, arm: Arm, readings: list[_Reading], rounded: _Roundings) -> Check:
    turned, moved, largest, outside = 0.0, 0.0, 0.0, []
    for index, body in enumerate(arm.bodies):
        joint = robot.joint[body.name]
        path = robot.path_to(joint.child)
        angle = _rounding_angle(path, rounded)
        reach = 1.0 + sum(float(np.linalg.norm(each.xyz)) for each in path)
        axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
        for reading in readings:
            rotation, origin = _frames(arm, reading.q)[index]
            pose = reading.poses[index]
            turn = float(np.abs(pose[:3, :3] @ axis - rotation[:, 2]).max())
            move = float(np.abs(pose[:3, 3] - origin).max())
            if turn > angle + _ROUNDING * len(path) or move > (angle + _ROUNDING * len(path)) * reach:
                outside.append(index)
            turned, moved, largest = max(turned, turn), max(moved, move), max(largest, angle)
    derived = f"axes and origins of the moving bodies as yourdfpy finds them{_within(largest)}"
    found = f"at most {size_told(turned)} rad and {size_told(moved)} m apart"
    return _check("frames in the file", derived, found, outside, "joint")


def _loads_agree(robot: Robot, arm: Arm, reading: _Reading, rounded: _Roundings) -> Check:
    worst, largest, outside = 0.0, 0.0, []
    frames = _frames(arm, reading.q)
    for index, (body, load) in enumerate(zip(arm.bodies, reading.loads, strict=True)):
        mass, hx, hy, hz, xx, xy, xz, yy, yz, zz = (float(x) for x in body.inertia or (0,) * 10)
        rotation = frames[index][0]
        tensor = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
        moment = rotation @ np.array([hx, hy, hz])
        errors = (
            abs(mass - load.mass),
            float(np.linalg.norm(moment - load.moment)),
            float(np.linalg.norm(tensor - load.tensor)),
        )
        error = max(each / (size or 1.0) for each, size in zip(errors, load.sizes, strict=True))
        links = [robot.link[name] for name in _carried(robot, arm, body.name)]
        angle = max(_rounding_angle(robot.path_to(link.name), rounded, link) for link in links)
        # turning by a small angle moves a vector by it and a tensor by twice of it
        if error > 2 * angle + 10 * _ROUNDING * len(robot.joints):
            outside.append(index)
        worst, largest = max(worst, error), max(largest, angle)
    derived = f"masses, their centres and tensors as yourdfpy finds them{_within(largest)}"
    return _check(
        "inertials in the file", derived, f"at most {size_told(worst)} of their size apart", outside, "body"
    )


def _check(fact: str, derived: str, found: str, outside: list[int], noun: str) -> Check:
    verdict: Verdict = "differs" if outside else "agrees"
    return Check(fact, derived, f"{found}, first at {noun} {outside[0] + 1}" if outside else found, verdict)


def _within(angle: float) -> str:
    return f", within the roundings told ({size_told(angle)} rad in all)" if angle else ""


def _rounding_angle(path: Sequence[Joint], rounded: _Roundings, link: Link | None = None) -> float:
    """How far [rad] what the diagnostics tell as rounded may have turned the end of ``path`` in all."""
    total = 0.0
    for joint in path:
        where = f"joint {joint.name!r}"
        total += _rounded_by(joint.rpy, rounded.get(f"{where} origin", ""))
        total += _AXIS_ROUNDING if f"{where} axis" in rounded else 0.0
        if joint.mimic is not None and joint.type != "prismatic":
            total += _to_special(joint.mimic.offset)  # not worth a diagnostic
    if link is not None and link.inertial is not None:
        total += _rounded_by(link.inertial.rpy, rounded.get(f"link {link.name!r} inertial origin", ""))
    return total


def _rounded_by(angles: Sequence[float], told: str) -> float:
    return sum(_to_special(angle) for angle in angles if f"{angle:.10g} is taken as" in told)


def _to_special(angle: float) -> float:
    """The distance [rad] to the nearest angle that the reader may have taken instead."""
    return min(abs(angle - round(angle / step) * step) for step in _STEPS)
