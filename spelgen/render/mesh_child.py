"""Process of limited time and memory that reads visual shapes: [URDF, LINK...] as JSON on stdin -> NPZ on stdout.

The limits are needed because mesh formats contain archives, names of other files and repetition counts.
"""

from __future__ import annotations

import gc
import io
import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from spelgen.errors import SpelgenError
from spelgen.files import read_bytes
from spelgen.render.tuning import TUNING

if TYPE_CHECKING:
    from yourdfpy import Visual

Mesh = Any
"""A mesh of trimesh, whose functions are annotated in part."""


class MeshFolder:
    """Resolver of trimesh for the files that a mesh names: only regular files in the folder of the mesh."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str) -> bytes:
        """Return the content of a file. Raises SpelgenError."""
        return read_bytes(self._folder / Path(name.strip()).name, SpelgenError, largest=TUNING.max_mesh_bytes)

    __getitem__ = get


def mesh_file(urdf: Path, name: str) -> Path:
    """Return the path of a mesh from its name in the URDF. Raises FileNotFoundError.

    The folder of the URDF and all its parents are searched, since any of these may be the folder of a package.
    """
    scheme, _, path_text = name.rpartition("://")
    path = Path(path_text)
    inner = Path(*path.parts[scheme == "package" :])
    for file in (urdf.parent / inner, path, *(folder / inner for folder in urdf.parents)):
        if os.path.isfile(file):  # unlike Path.is_file it raises no error for an invalid name
            return file
    raise FileNotFoundError(name)


def main(urdf: str, links: list[str], output: IO[bytes]) -> None:
    """Write the arrays v0, f0, v1, f1, ...: vertices (V, 3) [m] and faces (F, 3) of each link with visual shapes.

    Raises an error if a file is missing or is not a mesh: tubes show an arm better than an incomplete set of meshes.
    """
    with suppress(ImportError):  # not on Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (TUNING.mesh_memory,) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (TUNING.mesh_seconds,) * 2)
    import trimesh
    import yourdfpy

    model = yourdfpy.URDF.load(urdf, build_scene_graph=False, load_meshes=False)
    arrays: dict[str, Any] = {}
    for link in model.robot.links:
        if link.name not in links or not link.visuals:
            continue
        gc.collect()  # meshes contain reference cycles, so the meshes of other links would fill the memory
        mesh: Mesh = trimesh.util.concatenate([_shape(visual, Path(urdf)) for visual in link.visuals])
        # the area overflows for corners that are too far away
        if (
            not (np.isfinite(mesh.vertices).all() and mesh.area < np.inf)
            or len(mesh.faces) > TUNING.max_mesh_faces
        ):
            raise ValueError(f"{link.name}: too many triangles, or corners that are no numbers")
        if len(mesh.faces) > TUNING.faces // len(links):
            # an equal number of faces per link bounds the size of the page
            mesh = mesh.simplify_quadric_decimation(face_count=TUNING.faces // len(links), aggression=3)
        index = links.index(link.name)
        arrays |= {f"v{index}": np.asarray(mesh.vertices), f"f{index}": np.asarray(mesh.faces)}
    # in memory first: NumPy seeks backwards while it writes an archive, and a pipe cannot seek
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    output.write(buffer.getbuffer())


def _shape(visual: Visual, urdf: Path) -> Mesh:
    """Return the mesh of one <visual> in the frame of its link."""
    from trimesh import creation

    geometry = visual.geometry
    if geometry.box is not None:
        shape = creation.box(extents=geometry.box.size)
    elif geometry.cylinder is not None:
        shape = creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=12)
    elif geometry.sphere is not None:
        shape = creation.uv_sphere(geometry.sphere.radius, count=[8, 10])
    else:
        shape = _read(mesh_file(urdf, geometry.mesh.filename))
        if geometry.mesh.scale is not None:
            shape.apply_scale(geometry.mesh.scale)
    if visual.origin is not None:
        shape.apply_transform(visual.origin)
    return shape


def _read(path: Path) -> Mesh:
    """Return the mesh in a file. Raises ValueError if it has no triangles."""
    import trimesh

    content = io.BytesIO(read_bytes(path, SpelgenError, largest=TUNING.max_mesh_bytes))
    format, resolver = path.suffix.lower().lstrip("."), MeshFolder(path.parent)
    mesh: Mesh = trimesh.load(content, file_type=format, resolver=resolver, force="mesh")  # type: ignore[arg-type]
    # files repeat the vertices of each triangle: unmerged, the surface would tear when it is simplified
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not len(mesh.faces):
        raise ValueError(f"{path}: no triangles")
    return mesh


if __name__ == "__main__":
    urdf, *links = json.load(sys.stdin)
    main(urdf, links, sys.stdout.buffer)
