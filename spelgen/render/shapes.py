"""Shapes of links as polygons: tubes and drums of our own, and what a URDF shows of its links."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

SIDES = 10
LARGEST_FILE = 50_000_000  # bytes of a mesh that is read


@dataclass(frozen=True, eq=False)
class Shape:
    """Vertices (V, 3) [m] in the link's frame, and polygons of them, seen from outside counterclockwise."""

    vertices: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    faces: tuple[tuple[int, ...], ...] = ()


def joined(shapes: Sequence[Shape]) -> Shape:
    """All in one."""
    faces: list[tuple[int, ...]] = []
    count = 0
    for shape in shapes:
        faces += [tuple(count + k for k in face) for face in shape.faces]
        count += len(shape.vertices)
    return Shape(np.concatenate([np.zeros((0, 3)), *(x.vertices for x in shapes)]), tuple(faces))


def tube(start: np.ndarray, end: np.ndarray, radius: float, sides: int = SIDES) -> Shape:
    """A prism from start to end, with its lids."""
    along = (end - start) / np.linalg.norm(end - start)
    aside = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    aside /= np.linalg.norm(aside)
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = radius * (np.cos(angles)[:, None] * aside + np.sin(angles)[:, None] * np.cross(along, aside))
    around = [(k, (k + 1) % sides, sides + (k + 1) % sides, sides + k) for k in range(sides)]
    lids = [tuple(reversed(range(sides))), tuple(range(sides, 2 * sides))]
    return Shape(np.concatenate([start + ring, end + ring]), (*around, *lids))


def drum(axis: np.ndarray, radius: float) -> Shape:
    """A joint that turns about the axis."""
    return tube(-1.15 * radius * axis, 1.15 * radius * axis, radius)


def slide(axis: np.ndarray, radius: float) -> Shape:
    """A joint that slides along the axis."""
    return tube(-1.6 * radius * axis, 1.6 * radius * axis, 1.2 * radius, sides=4)


def visual_shapes(urdf: Path, links: Sequence[str], most: int) -> dict[str, Shape]:
    """What the URDF shows of these links, in at most so many faces together; nothing where a mesh is not found."""
    try:
        meshes = _meshes(urdf, set(links))
    except Exception:  # what the readers of a dozen mesh formats raise; the page stands without
        return {}
    total = sum(len(mesh.faces) for mesh in meshes.values())
    return {
        name: _shape(mesh, max(24, int(most * len(mesh.faces) / max(total, most))))
        for name, mesh in meshes.items()
    }


def _meshes(urdf: Path, links: set[str]) -> Mapping[str, Any]:
    """By link, in its frame. Raises where a file is not there: an arm with holes is worse than tubes."""
    import trimesh
    import yourdfpy

    logging.getLogger("yourdfpy").setLevel(logging.CRITICAL)
    model = yourdfpy.URDF.load(
        str(urdf), build_scene_graph=False, load_meshes=False, build_collision_scene_graph=False
    )
    found: dict[str, Any] = {}
    for link in model.robot.links:
        if link.name not in links:
            continue
        parts = []
        for visual in link.visuals:
            part = _mesh(visual.geometry, model, trimesh)
            if visual.origin is not None:
                part.apply_transform(visual.origin)
            parts.append(part)
        if parts:
            found[link.name] = trimesh.util.concatenate(parts)
    return found


def _mesh(geometry: Any, model: Any, trimesh: Any) -> Any:
    if geometry.box is not None:
        return trimesh.creation.box(extents=geometry.box.size)
    if geometry.cylinder is not None:
        return trimesh.creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=12)
    if geometry.sphere is not None:
        return trimesh.creation.uv_sphere(geometry.sphere.radius, count=[8, 10])
    path = Path(model._filename_handler(geometry.mesh.filename))
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError("a mesh too large for a page")
    mesh = trimesh.load(path, force="mesh")
    if geometry.mesh.scale is not None:
        mesh.apply_scale(geometry.mesh.scale)
    return mesh


def _shape(mesh: Any, most: int) -> Shape:
    """Its vertices drawn together on a grid, as coarse as it takes."""
    vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces)
    size = float(np.ptp(vertices, axis=0).max()) or 1.0
    cells = 512.0
    while True:
        grid = np.round(vertices / (size / cells)).astype(np.int64)
        _, inverse = np.unique(grid, axis=0, return_inverse=True)
        inverse = inverse.ravel()
        counts = np.bincount(inverse)
        means = np.stack([np.bincount(inverse, column) / counts for column in vertices.T], axis=1)
        kept = inverse[faces]
        a, b, c = kept.T
        kept = kept[(a != b) & (b != c) & (a != c)]
        _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
        if len(first) <= most or cells < 3:
            used, places = np.unique(kept[np.sort(first)], return_inverse=True)
            triangles = places.reshape(-1, 3).tolist()
            return Shape(means[used], tuple(map(tuple, triangles)))
        cells *= 0.8
