"""Shapes of links as triangles: tubes and drums of our own, and what a URDF shows of its links."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spelgen.settings.tuning.render import TUNING

if TYPE_CHECKING:
    import yourdfpy
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class Shape:
    """Vertices (V, 3) [m] in the link's frame, and triangles of them (F, 3), seen from outside counterclockwise."""

    vertices: np.ndarray
    faces: np.ndarray


def joined(meshes: Sequence[Trimesh]) -> Shape:
    """Return all meshes in one shape."""
    import trimesh

    if not meshes:
        return Shape(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    mesh: Any = trimesh.util.concatenate(meshes)
    return Shape(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def tube(start: np.ndarray, end: np.ndarray, radius: float, sides: int = 10) -> list[Trimesh]:
    """Return a prism from start to end, with its lids; none where they are nearer than half its radius."""
    import trimesh

    if np.linalg.norm(end - start) <= radius / 2:
        return []
    return [trimesh.creation.cylinder(radius, segment=[start, end], sections=sides)]


def drum(axis: np.ndarray, radius: float) -> list[Trimesh]:
    """Return a joint that turns about the axis."""
    return tube(-1.15 * radius * axis, 1.15 * radius * axis, radius)


def slide(axis: np.ndarray, radius: float) -> list[Trimesh]:
    """Return a joint that slides along the axis."""
    return tube(-1.6 * radius * axis, 1.6 * radius * axis, 1.2 * radius, sides=4)


def visual_shapes(urdf: Path, links: Sequence[str]) -> dict[str, Shape]:
    """Return what the URDF shows of these links, simplified to fit a page; nothing where a mesh is not found."""
    try:
        shapes = _visual_shapes(urdf, links)
    except Exception:  # what the readers of a dozen mesh formats raise; the page stands without
        return {}
    total = sum(len(shape.faces) for shape in shapes.values())
    simple = {}
    for name, shape in shapes.items():
        share = len(shape.faces) / max(total, TUNING.faces)
        simple[name] = _simplified(shape, max(24, int(TUNING.faces * share)))
    return simple


def _visual_shapes(urdf: Path, links: Sequence[str]) -> dict[str, Shape]:
    """Return shapes in the links' frames. Raises where a file is not there: an arm with holes is worse than tubes."""
    import yourdfpy

    # it warns of every mesh that it does not find, which the page says in one sentence
    logging.getLogger("yourdfpy").setLevel(logging.CRITICAL)
    model = yourdfpy.URDF.load(
        str(urdf), build_scene_graph=False, load_meshes=False, build_collision_scene_graph=False
    )
    shapes = {}
    for link in model.robot.links:
        meshes = []
        for visual in link.visuals:
            if link.name not in links:
                break
            mesh = _mesh(visual.geometry, model)
            if visual.origin is not None:
                mesh.apply_transform(visual.origin)
            meshes.append(mesh)
        if meshes:
            shapes[link.name] = joined(meshes)
    return shapes


def _mesh(geometry: yourdfpy.Geometry, model: yourdfpy.URDF) -> Trimesh:
    import trimesh

    if geometry.box is not None:
        box: Trimesh = trimesh.creation.box(extents=geometry.box.size)
        return box
    if geometry.cylinder is not None:
        radius, length = geometry.cylinder.radius, geometry.cylinder.length
        cylinder: Trimesh = trimesh.creation.cylinder(radius, length, sections=12)
        return cylinder
    if geometry.sphere is not None:
        sphere: Trimesh = trimesh.creation.uv_sphere(geometry.sphere.radius, count=[8, 10])
        return sphere
    path = Path(model._filename_handler(geometry.mesh.filename))
    if path.stat().st_size > TUNING.mesh_bytes:
        raise ValueError("a mesh too large for a page")
    mesh: Any = trimesh.load(path, force="mesh")
    if geometry.mesh.scale is not None:
        mesh.apply_scale(geometry.mesh.scale)
    loaded: Trimesh = mesh
    return loaded


def _simplified(shape: Shape, count: int) -> Shape:
    """Return at most so many triangles: vertices are drawn together on a grid, as coarse as it takes."""
    size = float(np.ptp(shape.vertices, axis=0).max()) or 1.0
    cells = 512.0
    while True:
        grid = np.round(shape.vertices * (cells / size)).astype(np.int64)
        _, cluster = np.unique(grid, axis=0, return_inverse=True)
        faces = cluster.ravel()[shape.faces]
        a, b, c = faces.T
        # triangles whose corners fell together have no area
        faces = faces[(a != b) & (b != c) & (a != c)]
        # two triangles of the same corners lie in one place
        _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
        if len(first) <= count or cells < 3:
            break
        cells *= 0.8
    members = np.bincount(cluster.ravel())
    means = np.stack([np.bincount(cluster.ravel(), column) for column in shape.vertices.T], axis=1)
    used, triangles = np.unique(faces[np.sort(first)], return_inverse=True)
    return Shape(means[used] / members[used, None], triangles.reshape(-1, 3))
