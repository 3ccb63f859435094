"""Process of limited time and memory that reads meshes: {"faces": N, "meshes": [[PATH, SCALE]]} on stdin -> NPZ.

The limits are needed because mesh formats contain archives, names of other files and repetition counts.
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
"""Size of the largest file with a mesh."""


class MeshFolder:
    """Resolver of trimesh for the files that a mesh names: only regular files in the folder of the mesh."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str) -> bytes:
        """Return the content of a file. Raises SpelgenError."""
        return read_bytes(self._folder / Path(name.strip()).name, SpelgenError, largest=MAX_BYTES)

    __getitem__ = get


def main(faces: int, meshes: list[tuple[str, list[float]]], output: IO[bytes]) -> None:
    """Write the arrays v0, f0, v1, f1, ...: vertices (V, 3) [m] and triangles (F, 3) of each mesh that can be read.

    Args:
        faces: Largest number of triangles of a mesh; meshes of more triangles are simplified.
        meshes: Path and scale along x, y and z of each mesh.
        output: Is written to.
    """
    with suppress(ImportError):  # not on Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (2**30,) * 2)
        # [s] imports and the simplification of fine meshes take most of the time
        resource.setrlimit(resource.RLIMIT_CPU, (30,) * 2)
    arrays: dict[str, np.ndarray] = {}
    for index, (path, scale) in enumerate(meshes):
        gc.collect()  # meshes contain reference cycles, so the meshes of other links would fill the memory
        # readers of trimesh raise errors of any type; the parent process names the meshes without arrays
        with suppress(Exception):
            mesh = _read(Path(path), scale, faces)
            arrays |= {f"v{index}": np.asarray(mesh.vertices), f"f{index}": np.asarray(mesh.faces)}
    # in memory first: NumPy seeks backwards while it writes an archive, and a pipe cannot seek
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    output.write(buffer.getbuffer())


def _read(path: Path, scale: list[float], faces: int) -> Trimesh:
    """Return the scaled mesh in a file, with at most `faces` triangles. Raises ValueError if it has none."""
    import trimesh

    content = io.BytesIO(read_bytes(path, SpelgenError, largest=MAX_BYTES))
    format, resolver = path.suffix.lower().lstrip("."), MeshFolder(path.parent)
    mesh: Any = trimesh.load(content, file_type=format, resolver=resolver, force="mesh")  # type: ignore[arg-type]
    # files repeat the vertices of each triangle: unmerged, the surface would tear when it is simplified
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.apply_scale(scale)
    # the area overflows for corners that are too far away
    is_finite = np.isfinite(mesh.vertices).all() and mesh.area < np.inf
    # archives may expand without end
    if not is_finite or not 0 < len(mesh.faces) <= 2_000_000:
        raise ValueError(f"{path}: no triangles, too many triangles, or corners that are no numbers")
    if len(mesh.faces) > faces:
        mesh = mesh.simplify_quadric_decimation(face_count=faces, aggression=3)
    result: Trimesh = mesh
    return result


if __name__ == "__main__":
    main(**json.load(sys.stdin), output=sys.stdout.buffer)
