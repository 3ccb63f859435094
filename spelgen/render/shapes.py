"""Shapes of links as triangles: tubes and drums of our own, and what a URDF shows of its links."""

from __future__ import annotations

import io
import logging
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import PlainSerializer, PlainValidator

from spelgen.evaluation.plain import Curve
from spelgen.render import mesh_child
from spelgen.settings.tuning.render import TUNING

if TYPE_CHECKING:
    import yourdfpy
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class Shape:
    """Vertices (V, 3) [m] in the link's frame, and triangles of them (F, 3), seen from outside counterclockwise."""

    vertices: Curve
    faces: Annotated[np.ndarray, PlainValidator(np.array), PlainSerializer(np.ndarray.tolist)]


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
        with np.errstate(all="ignore"):  # corners may lie anywhere
            return _simplified(_visual_meshes(urdf, links))
    except Exception:  # what the readers of a dozen mesh formats raise; the page stands without
        return {}


def _simplified(meshes: Mapping[str, Trimesh]) -> dict[str, Shape]:
    """Return the meshes with as many faces as a page bears. Raises where a mesh is without measure."""
    area = sum(mesh.area for mesh in meshes.values()) or 1.0
    if not np.isfinite(area):
        raise ValueError("a mesh without an area")
    shapes = {}
    for name, mesh in meshes.items():
        # by size: a fine mesh of a small screw gets no more faces than it shows
        count = max(TUNING.least_faces, int(TUNING.faces * mesh.area / area))
        if len(mesh.faces) > count:
            mesh = mesh.simplify_quadric_decimation(face_count=count, aggression=3)
        shapes[name] = Shape(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return shapes


def _visual_meshes(urdf: Path, links: Sequence[str]) -> dict[str, Any]:
    """Return meshes in the links' frames, one a link.

    Raises where a file is missing: an arm with holes is worse than tubes.
    """
    import trimesh
    import yourdfpy

    # it warns of every mesh that it does not find, which the page says in one sentence
    logging.getLogger("yourdfpy").setLevel(logging.CRITICAL)
    model = yourdfpy.URDF.load(
        str(urdf), build_scene_graph=False, load_meshes=False, build_collision_scene_graph=False
    )
    shown = [link for link in model.robot.links if link.name in links and link.visuals]
    paths = {}
    for link in shown:
        for visual in link.visuals:
            mesh = visual.geometry.mesh
            if mesh is not None:
                paths[mesh.filename] = Path(model._filename_handler(mesh.filename))
    # all at once: to start a process takes longer than to read a mesh
    files = _read_meshes(paths)
    by_link = {}
    for link in shown:
        meshes = []
        for visual in link.visuals:
            shape = _mesh(visual.geometry, files)
            if visual.origin is not None:
                shape.apply_transform(visual.origin)
            meshes.append(shape)
        by_link[link.name] = trimesh.util.concatenate(meshes)
    return by_link


def _read_meshes(files: Mapping[str, Path]) -> dict[str, Trimesh]:
    """Return the meshes in these files.

    Raises OSError where one is missing, and CalledProcessError where one is no mesh, or too large for a page.
    """
    import trimesh

    if not files:
        return {}
    for path in files.values():
        path.stat()  # a process takes longer to start than to find that a file is missing
    command = [sys.executable, "-P", "-m", mesh_child.__name__, *map(str, files.values())]
    # a file may say that it is a thousand times as large as it is, or name one that never ends
    run = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=60, check=True)
    arrays = np.load(io.BytesIO(run.stdout))
    meshes = {}
    for index, name in enumerate(files):
        meshes[name] = trimesh.Trimesh(arrays[f"v{index}"], arrays[f"f{index}"], process=False)
    return meshes


def _mesh(geometry: yourdfpy.Geometry, files: Mapping[str, Trimesh]) -> Trimesh:
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
    mesh: Any = files[geometry.mesh.filename].copy()
    if geometry.mesh.scale is not None:
        mesh.apply_scale(geometry.mesh.scale)
    scaled: Trimesh = mesh
    return scaled
