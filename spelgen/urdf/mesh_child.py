"""Program that reads meshes in a process of limited time and memory.

It reads {"faces": N, "meshes": [[PATH, SCALE], ...]} as JSON from stdin and writes an NPZ archive to stdout. The limits
are needed because a small mesh file can take unlimited memory or time: it may be an archive, name other files or
contain repetition counts.
"""

from __future__ import annotations

import gc
import io
import json
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from spelgen.errors import SpelgenError
from spelgen.files import read_bytes

if TYPE_CHECKING:
    from trimesh import Trimesh


MAX_BYTES = 50_000_000
"""Size of the largest mesh file that is read [bytes]."""


class MeshFolder:
    """Resolver with which trimesh opens the files that a mesh names: only regular files in the folder of the mesh."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str) -> bytes:
        """Return the content of the file of this name in the folder of the mesh; a path in the name is ignored.

        Raises SpelgenError for an absent, unreadable or too large file.
        """
        return read_bytes(self._folder / Path(name.strip()).name, SpelgenError, largest=MAX_BYTES)

    __getitem__ = get


def main(faces: int, meshes: list[tuple[str, list[float]]], output: IO[bytes]) -> None:
    """Write the arrays v0, f0, v1, f1, ...: V vertices (V, 3) [m] and F triangles (F, 3) of each mesh that can be read.

    Args:
        faces: Largest number of triangles of each mesh; meshes with more triangles are simplified.
        meshes: Path, and scale factors along x, y and z, of each mesh.
        output: Binary file to which the arrays are written as an NPZ archive.
    """
    with suppress(ImportError):  # On Windows there is no module `resource`, and the process has no limits.
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (2**30,) * 2)
        # [s] Largest processor time of this process, most of which is spent on imports and on the simplification of
        # fine meshes.
        resource.setrlimit(resource.RLIMIT_CPU, (30,) * 2)
    arrays: dict[str, np.ndarray] = {}
    for index, (path, scale) in enumerate(meshes):
        # A mesh of trimesh contains reference cycles, which only the garbage collector frees: without it, the meshes
        # that were read before would fill the memory.
        gc.collect()
        # The readers of trimesh raise errors of any type. A mesh with an error has no arrays in the archive, and the
        # parent process omits it.
        with suppress(Exception):
            mesh = _read(Path(path), scale, faces)
            arrays |= {f"v{index}": np.asarray(mesh.vertices), f"f{index}": np.asarray(mesh.faces)}
    # The archive is written in memory first, because NumPy seeks in the file, and a pipe cannot seek.
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    output.write(buffer.getbuffer())


def _read(path: Path, scale: list[float], faces: int) -> Trimesh:
    """Return the scaled mesh in a file, with at most `faces` triangles. Raises ValueError if it has no triangles."""
    import trimesh

    content = io.BytesIO(read_bytes(path, SpelgenError, largest=MAX_BYTES))
    format, resolver = path.suffix.lower().lstrip("."), MeshFolder(path.parent)
    mesh: Any = trimesh.load(content, file_type=format, resolver=resolver, force="mesh")  # type: ignore[arg-type]
    # Equal vertices are merged, because some formats repeat the vertices of each triangle: simplification would then
    # tear the surface.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.apply_scale(scale)
    # The area of the mesh is tested too, because it overflows for vertices that are too far away.
    is_finite = np.isfinite(mesh.vertices).all() and mesh.area < np.inf
    # The number of triangles is bounded, because a small mesh file in a compressed format may expand to any size.
    if not is_finite or not 0 < len(mesh.faces) <= 2_000_000:
        raise ValueError(f"{path}: no triangles, too many triangles, or corners that are no numbers")
    if len(mesh.faces) > faces:
        mesh = mesh.simplify_quadric_decimation(face_count=faces, aggression=3)
    result: Trimesh = mesh
    return result


if __name__ == "__main__":
    main(**json.load(sys.stdin), output=sys.stdout.buffer)
