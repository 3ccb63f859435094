"""Read the file once more by yourdfpy: axes, origins and masses of every moving body beside the Arm's.

Errors in reading show here that no check of the derivation could see: it starts from the Arm.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from math import pi
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.arm.rational import rotation_about
from spelgen.certificate.verification import Check, size_text
from spelgen.settings.tuning.structure import CertificateTuning, GeometryTuning
from spelgen.structure.pseudo_inertia import pseudo_inertia
from spelgen.urdf.robot import Joint, Link, Robot

if TYPE_CHECKING:
    from yourdfpy import URDF

GEOMETRY = GeometryTuning()
TUNING = CertificateTuning()

Roundings = dict[str, str]
"""What the arm's diagnostics say was rounded, by place in the file."""


@dataclass(frozen=True)
class _Reading:
    """Hold world poses (4, 4) of every body's link at one configuration ``q``, and every body's load."""

    q: np.ndarray
    poses: list[np.ndarray]
    loads: list[_Load]


@dataclass(frozen=True)
class _Load:
    """Hold what hangs on one body: its pseudo-inertia (4, 4) in world axes about the body's origin.

    ``mass`` [kg] and ``reach`` [m] are the sizes that its errors are measured by.
    """

    pseudo: np.ndarray
    mass: float
    reach: float


def urdf_cross_check(robot: Robot, arm: Arm, *, samples: int = 6, seed: int = 0) -> tuple[Check, ...]:
    """Compare ``arm`` with yourdfpy's reading of the same bytes at random configurations.

    Where nothing was rounded the two agree to rounding; where something was, within the roundings that the
    arm's diagnostics name.
    """
    try:
        readings = list(_yourdfpy_readings(robot, arm, samples, seed))
    except Exception as problem:  # another program's failure proves nothing about ours
        text = " ".join(str(problem).split())[:120]
        result = f"yourdfpy fails ({type(problem).__name__}: {text})"
        return (Check("reading of the file", "the moving bodies", result, "undecided"),)
    rounded: Roundings = {}
    for diagnostic in arm.diagnostics:
        if diagnostic.code.startswith("snapped-"):
            rounded[diagnostic.where] = f"{rounded.get(diagnostic.where, '')}; {diagnostic.message}"
    checks = [_check_frames(robot, arm, readings, rounded)]
    if any(body.inertia is not None for body in arm.bodies):
        checks.append(_check_loads(robot, arm, readings[0], rounded))
    return tuple(checks)


def _yourdfpy_readings(robot: Robot, arm: Arm, samples: int, seed: int) -> Iterator[_Reading]:
    # the same bytes, or the comparison would prove nothing
    data = robot.path.read_bytes()
    if hashlib.sha256(data).hexdigest() != robot.digest:
        raise ValueError("the file has changed since it was read")
    model = _yourdfpy_model(data)
    rng = np.random.default_rng(seed)
    names = arm.joint_names
    spans = np.array([pi if coordinate.kind == "revolute" else 0.5 for coordinate in arm.coordinates])
    for _ in range(samples):
        q = rng.uniform(-1, 1, len(names)) * spans
        model.update_cfg(dict(zip(names, q.tolist(), strict=True)))
        poses, loads = [], []
        for body in arm.bodies:
            pose = model.get_transform(robot.joint[body.name].child, robot.root)
            poses.append(pose)
            loads.append(_load(robot, arm, model, robot.joint[body.name], pose[:3, 3]))
        yield _Reading(q, poses, loads)


def _yourdfpy_model(data: bytes) -> URDF:
    import yourdfpy  # slow to import

    logger = logging.getLogger("yourdfpy")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # it warns of what read_urdf has said already
    try:
        parsed = yourdfpy.URDF.load(BytesIO(data), build_scene_graph=False, load_meshes=False).robot
        # yourdfpy resolves one level of mimic joints only
        followers = {joint.name for joint in parsed.joints if joint.mimic is not None}
        for joint in parsed.joints:
            if joint.mimic is not None and joint.mimic.joint in followers:
                raise ValueError("a mimic joint that follows a mimic joint")
            if joint.axis is not None:
                # a prismatic joint would move by the axis as it is written, however long
                joint.axis = joint.axis / (np.linalg.norm(joint.axis) or 1.0)
        # meshes are not needed, and most machines do not have them
        for link in parsed.links:
            link.visuals, link.collisions = [], []
        return yourdfpy.URDF(parsed, build_scene_graph=True, load_meshes=False)
    finally:
        logger.setLevel(level)


def _load(robot: Robot, arm: Arm, model: URDF, joint: Joint, origin: np.ndarray) -> _Load:
    """Return the sum of yourdfpy's inertials on the links that move with ``joint``."""
    pseudo = np.zeros((4, 4))
    mass, second_moment, reach = 0.0, 0.0, 0.0
    for name in _carried(robot, arm, joint):
        inertial = model.link_map[name].inertial
        if inertial is None or inertial.mass is None:
            continue
        frame = model.get_transform(name, robot.root)
        if inertial.origin is not None:
            frame = frame @ inertial.origin
        tensor = np.zeros((3, 3))
        if inertial.inertia is not None:
            tensor = inertial.inertia
        frame = frame.copy()
        frame[:3, 3] -= origin
        central = pseudo_inertia(np.array([inertial.mass, 0.0, 0.0, 0.0, *tensor[np.triu_indices(3)]]))
        pseudo += frame @ central @ frame.T
        mass += abs(inertial.mass)
        second_moment += float(np.linalg.norm(tensor))
        # errors grow with the way to the link, not with how far it is in the end
        way = sum(np.linalg.norm(held.xyz) for held in _held_between(robot, joint, name))
        reach = max(reach, float(way + np.linalg.norm(frame[:3, 3])))
    # a tensor larger than the lever explains sets the scale of its own errors
    if second_moment > mass * reach**2 and mass > 0:
        reach = (second_moment / mass) ** 0.5
    return _Load(pseudo, mass or 1.0, reach or 1.0)


def _carried(robot: Robot, arm: Arm, joint: Joint) -> list[str]:
    """Return the links that move with ``joint`` and with none of the other moving joints behind it."""
    moving = {body.name for body in arm.bodies}
    links = [joint.child]
    for link in links:  # grows while it is walked
        for below in robot.joints_below[link]:
            if below.name not in moving:
                links.append(below.child)
    return links


def _held_between(robot: Robot, joint: Joint, link: str) -> tuple[Joint, ...]:
    """Return the joints from behind ``joint`` to ``link``, all of them held."""
    return robot.path_to(link)[len(robot.path_to(joint.child)) :]


def _arm_poses(arm: Arm, q: np.ndarray) -> list[np.ndarray]:
    """Return the world pose (4, 4) of every body at ``q`` (n,), from the Arm's exact poses."""
    poses: list[np.ndarray] = []
    for body in arm.bodies:
        rest = np.eye(4)
        rest[:3, :3] = body.rotation
        rest[:3, 3] = body.translation
        value = float(body.multiplier) * q[body.coordinate] + body.offset
        motion = np.eye(4)
        if body.kind == "prismatic":
            motion[2, 3] = value
        else:
            motion[:3, :3] = rotation_about(np.array([0.0, 0.0, 1.0]), value)
        parent = np.eye(4)
        if body.parent >= 0:
            parent = poses[body.parent]
        poses.append(parent @ rest @ motion)
    return poses


def _check_frames(robot: Robot, arm: Arm, readings: list[_Reading], rounded: Roundings) -> Check:
    turned, moved, largest = 0.0, 0.0, 0.0
    outside: list[int] = []
    poses = [_arm_poses(arm, reading.q) for reading in readings]
    for index, body in enumerate(arm.bodies):
        joint = robot.joint[body.name]
        path = robot.path_to(joint.child)
        angle = _rounding_angle(path, rounded)
        allowed = angle + TUNING.frame_rounding * len(path)
        reach = 1.0 + sum(float(np.linalg.norm(step.xyz)) for step in path)
        axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
        for reading, ours in zip(readings, poses, strict=True):
            pose = reading.poses[index]
            turn = float(np.abs(pose[:3, :3] @ axis - ours[index][:3, 2]).max())
            move = float(np.abs(pose[:3, 3] - ours[index][:3, 3]).max())
            if turn > allowed or move > allowed * reach:
                outside.append(index)
            turned, moved = max(turned, turn), max(moved, move)
        largest = max(largest, angle)
    derived = f"axes and origins of the moving bodies as yourdfpy finds them{_within(largest)}"
    result = f"at most {size_text(turned)} rad and {size_text(moved)} m apart"
    return _check("frames in the file", derived, result, outside, "joint")


def _check_loads(robot: Robot, arm: Arm, reading: _Reading, rounded: Roundings) -> Check:
    worst, largest = 0.0, 0.0
    outside: list[int] = []
    poses = _arm_poses(arm, reading.q)
    for index, body in enumerate(arm.bodies):
        load = reading.loads[index]
        turn = np.eye(4)
        turn[:3, :3] = poses[index][:3, :3]
        ours = turn @ pseudo_inertia(np.array(body.inertia or np.zeros(10), dtype=float)) @ turn.T
        # a metre of lever counts as much as the body's reach: one measure for mass, moment and tensor
        scale = np.array([load.reach, load.reach, load.reach, 1.0])
        error = float(np.abs((ours - load.pseudo) / np.outer(scale, scale)).max()) / load.mass
        angle = 0.0
        for name in _carried(robot, arm, robot.joint[body.name]):
            angle = max(angle, _rounding_angle(robot.path_to(name), rounded, robot.link[name]))
        # turning by a small angle moves a vector by it and a tensor by twice of it
        if error > 2 * angle + 10 * TUNING.frame_rounding * len(robot.joints):
            outside.append(index)
        worst, largest = max(worst, error), max(largest, angle)
    derived = f"masses, their centres and tensors as yourdfpy finds them{_within(largest)}"
    result = f"at most {size_text(worst)} of their size apart"
    return _check("inertials in the file", derived, result, outside, "body")


def _check(fact: str, derived: str, result: str, outside: list[int], noun: str) -> Check:
    if outside:
        return Check(fact, derived, f"{result}, first at {noun} {outside[0] + 1}", "differs")
    return Check(fact, derived, result, "agrees")


def _within(angle: float) -> str:
    if not angle:
        return ""
    return f", within the reported roundings ({size_text(angle)} rad in all)"


def _rounding_angle(path: Sequence[Joint], rounded: Roundings, link: Link | None = None) -> float:
    """Return how far [rad] what the diagnostics name as rounded may have turned the end of ``path`` in all."""
    total = 0.0
    for joint in path:
        where = f"joint {joint.name!r}"
        total += _rounded_by(joint.rpy, rounded.get(f"{where} origin", ""))
        if f"{where} axis" in rounded:
            total += 1.5 * GEOMETRY.axis_noise  # two components, each below it
        if joint.mimic is not None and joint.type != "prismatic":
            total += _to_special(joint.mimic.offset)  # rounded without a diagnostic
    if link is not None and link.inertial is not None:
        total += _rounded_by(link.inertial.rpy, rounded.get(f"link {link.name!r} inertial origin", ""))
    return total


def _rounded_by(angles: Sequence[float], message: str) -> float:
    total = 0.0
    for angle in angles:
        if f"{angle:.10g} is taken as" in message:
            total += _to_special(angle)
    return total


def _to_special(angle: float) -> float:
    """Return the distance [rad] to the nearest angle that the reader may have taken instead."""
    steps = pi / np.array((2, *GEOMETRY.fine_divisors))
    return float(np.abs(angle - np.round(angle / steps) * steps).min())
