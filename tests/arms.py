"""Small serial arms with exact rational geometry, and the arms of the reference data with their known structure."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from spelgen.arm.arm import Body, Chain, Coordinate, make_arm
from spelgen.structure.structure import Structure, derive
from spelgen.urdf.read import read_urdf

Rows = tuple[tuple[Fraction, Fraction, Fraction], ...]

STRAIGHT = tuple(tuple(Fraction(int(i == j)) for j in range(3)) for i in range(3))


def chain(
    links: Sequence[tuple[str, Rows, Sequence[float]]], gravity: Sequence[float] = (0, 0, -9.81)
) -> Chain:
    """Return a serial arm without inertials.

    links: per joint, its type, and its frame's rotation (3, 3) and translation (3,) [m] in the parent's frame.
    """
    bodies = tuple(
        Body(
            f"j{i + 1}",
            f"l{i + 1}",
            kind,
            i - 1,
            i,
            Fraction(1),
            0.0,
            rotation,
            tuple(Fraction(str(x)) for x in offset),
            None,
        )
        for i, (kind, rotation, offset) in enumerate(links)
    )
    coordinates = tuple(
        Coordinate(
            body.name, body.joint_type, body.joint_type == "revolute", None, None, None, None, 0.0, 0.0, False
        )
        for body in bodies
    )
    return Chain("arm", coordinates, bodies, tuple(Fraction(str(g)) for g in gravity), (), ())


def planar(joints: int) -> Chain:
    """Return a planar arm: turning joints with parallel vertical axes, half a metre apart."""
    return chain([("revolute", STRAIGHT, (0.5 * (i > 0), 0, 0)) for i in range(joints)])


def random_arm(joints: int, seed: int) -> Chain:
    """Return an arm of turning joints with random rational rotations and offsets: no axes are parallel or intersect."""
    rng = np.random.default_rng(seed)
    return chain(
        [
            ("revolute", random_rotation(rng), np.round(rng.uniform(-0.5, 0.5, 3), 4).tolist())
            for _ in range(joints)
        ]
    )


def random_rotation(rng: np.random.Generator) -> Rows:
    """Return a random rotation matrix (3, 3) of fractions, exactly orthogonal."""
    w, x, y, z = (Fraction(int(a), 1000) for a in rng.integers(-1000, 1000, 4))
    n = w * w + x * x + y * y + z * z
    rows = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return tuple(tuple(a / n for a in row) for row in rows)


def reference_arms(shared: Path, assume: str) -> Iterator[tuple[str, dict[str, Any], Chain, Structure]]:
    """Yield the name, known structure, chain and derived structure (of M and V) of each arm of the reference data.

    assume: "kinematics" for the structure that is valid for all inertial parameters, "inertials" for the structure with
    the URDF's values. Arms without such a known structure are omitted. A structure is derived once per process.
    """
    for name, known in json.loads((shared / "arms" / "expected.json").read_text()).items():
        if known[assume] is not None:
            joints = known["joints"] and tuple(known["joints"])
            yield name, known[assume], *_reference(shared / "arms" / f"{name}.urdf", joints, assume)


@cache
def _reference(path: Path, joints: tuple[str, ...] | None, assume: str) -> tuple[Chain, Structure]:
    arm = _arm(path, joints)
    return arm, derive(arm, assume)


@cache
def _arm(path: Path, joints: tuple[str, ...] | None) -> Chain:
    return make_arm(read_urdf(path), joints=joints)
