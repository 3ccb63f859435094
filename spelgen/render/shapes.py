"""Shapes of links as triangles: tubes, and the visual shapes of a URDF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, cast

import numpy as np
from pydantic import PlainSerializer, PlainValidator

from spelgen.evaluation.plain import Curve
from spelgen.urdf.geometry import LinkShape

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class Shape:
    """Vertices (V, 3) [m] in the link frame; triangles as vertex indices (F, 3), counterclockwise from outside."""

    vertices: Curve
    faces: Annotated[np.ndarray, PlainValidator(np.array), PlainSerializer(np.ndarray.tolist)]


def joined(meshes: Sequence[Trimesh]) -> Shape:
    """Return one shape with the triangles of all meshes."""
    import trimesh

    if not meshes:
        return Shape(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    mesh = cast("Trimesh", trimesh.util.concatenate(meshes))
    return Shape(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def tube(start: np.ndarray, end: np.ndarray, radius: float, sides: int = 10) -> list[Trimesh]:
    """Return a closed prism, or nothing if it would be shorter than half its radius.

    Args:
        start: First end of the axis, (3,) [m].
        end: Last end of the axis, (3,) [m].
        radius: Radius of the circumscribed cylinder [m].
        sides: Number of sides.
    """
    import trimesh

    if np.linalg.norm(end - start) <= radius / 2:
        return []
    return [trimesh.creation.cylinder(radius, segment=[start, end], sections=sides)]


def triangles(shape: LinkShape) -> Trimesh:
    """Return the triangles of a shape in the frame of its link."""
    from trimesh import Trimesh, creation

    if shape.mesh is not None:
        mesh = Trimesh(*shape.mesh, process=False)
    elif shape.kind == "box":
        mesh = creation.box(extents=shape.size)
    elif shape.kind == "cylinder":
        mesh = creation.cylinder(radius=shape.size[0], height=shape.size[1], sections=12)
    else:
        mesh = creation.uv_sphere(shape.size[0], count=[8, 10])
    mesh.apply_transform(shape.pose)
    return mesh
