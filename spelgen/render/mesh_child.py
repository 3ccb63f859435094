"""Reads what a URDF shows, in a process of bounded time and memory: [URDF, LINK...] as JSON -> NPZ on stdout.

Readers of a dozen formats unpack archives, follow names of other files and repeat parts as often as a file says.
"""

import gc
import io
import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from spelgen.errors import SpelgenError
from spelgen.files import read_bytes
from spelgen.render.tuning import TUNING

MEMORY = 1_073_741_824  # bytes
SECONDS = 30  # of processor time: imports and simplification of fine meshes take most of it
LARGEST = 50_000_000  # bytes of a file
FACES = 2_000_000  # of a link: more are an archive that unpacks to no end


class Neighbours:
    """Opens what a mesh names: regular files of its own folder alone, as trimesh asks for them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str) -> bytes:
        """Return what a file holds. Raises SpelgenError."""
        return read_bytes(self._folder / Path(name.strip()).name, SpelgenError, largest=LARGEST)

    __getitem__ = get


def mesh_file(urdf: Path, name: str) -> Path:
    """Return the file of a mesh by what the URDF calls it. Raises FileNotFoundError.

    It is looked for beside the URDF and in all folders above, which a package's name may stand for.
    """
    scheme, _, rest = name.rpartition("://")
    path = Path(rest)
    inner = Path(*path.parts[scheme == "package" :])
    for place in (urdf.parent / inner, path, *(folder / inner for folder in urdf.parents)):
        if os.path.isfile(place):  # unlike Path.is_file it answers for names that no system takes
            return place
    raise FileNotFoundError(name)


def main(urdf: str, links: list[str], output: IO[bytes]) -> None:
    """Write the arrays v0, f0, v1, f1, ...: vertices (V, 3) and faces (F, 3) of each link that the URDF shows.

    Raises where a file is missing or is no mesh: an arm with holes is worse than tubes.
    """
    with suppress(ImportError):  # not on Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    import trimesh
    import yourdfpy

    model = yourdfpy.URDF.load(urdf, build_scene_graph=False, load_meshes=False)
    arrays: dict[str, Any] = {}
    for link in model.robot.links:
        if link.name not in links or not link.visuals:
            continue
        gc.collect()  # meshes refer to themselves: those of other links would fill the memory
        mesh: Any = trimesh.util.concatenate([_shape(visual, Path(urdf)) for visual in link.visuals])
        # a box without size has an area of 0, corners that are no numbers or too far away have none
        if not (np.isfinite(mesh.vertices).all() and mesh.area < np.inf) or len(mesh.faces) > FACES:
            raise ValueError(f"{link.name}: too many triangles, or corners that are no numbers")
        if len(mesh.faces) > TUNING.faces // len(links):
            mesh = mesh.simplify_quadric_decimation(face_count=TUNING.faces // len(links), aggression=3)
        index = links.index(link.name)
        arrays |= {f"v{index}": np.asarray(mesh.vertices), f"f{index}": np.asarray(mesh.faces)}
    # in memory first: NumPy writes an archive by going back in its file, which a pipe does not allow
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    output.write(buffer.getbuffer())


def _shape(visual: Any, urdf: Path) -> Any:
    """Return a visual of the URDF as a mesh in its link's frame."""
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


def _read(path: Path) -> Any:
    """Return the mesh in a file."""
    import trimesh

    content = io.BytesIO(read_bytes(path, SpelgenError, largest=LARGEST))
    kind, neighbours = path.suffix.lower().lstrip("."), Neighbours(path.parent)
    mesh: Any = trimesh.load(content, file_type=kind, resolver=neighbours, force="mesh")  # type: ignore[arg-type]
    # files give each triangle or patch corners of its own: apart, they would tear when they are simplified
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not len(mesh.faces):
        raise ValueError(f"{path}: no triangles")
    return mesh


if __name__ == "__main__":
    urdf, *links = json.load(sys.stdin)
    main(urdf, links, sys.stdout.buffer)
