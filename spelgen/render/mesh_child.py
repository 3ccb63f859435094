"""Reads meshes in a process that ``shapes`` starts, of bounded time and memory: FILE... -> NPZ on stdout.

Readers of a dozen formats unpack archives, follow names of other files and repeat parts as often as a file says.
"""

import io
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from spelgen.errors import SpelgenError
from spelgen.files import read_bytes

MEMORY = 1_073_741_824  # bytes
SECONDS = 8  # of processor time
LARGEST = 50_000_000  # bytes of a file
FACES = 2_000_000  # of all files together: more are an archive that unpacks to no end


class Neighbours:
    """Opens what a mesh names: regular files of its own folder alone, as trimesh asks for them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str) -> bytes:
        """Return what a file holds. Raises SpelgenError."""
        return read_bytes(self._folder / Path(name.strip()).name, SpelgenError, largest=LARGEST)

    __getitem__ = get


def main(paths: list[Path], output: IO[bytes]) -> None:
    """Write the arrays v0, f0, v1, f1, ...: vertices (V, 3) and faces (F, 3) of each file."""
    with suppress(ImportError):  # not on Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    import trimesh

    arrays: dict[str, Any] = {}
    faces = 0
    for index, path in enumerate(paths):
        kind = path.suffix.lower().lstrip(".")
        content = io.BytesIO(read_bytes(path, SpelgenError, largest=LARGEST))
        neighbours: Any = Neighbours(path.parent)
        mesh: Any = trimesh.load(content, file_type=kind, resolver=neighbours, force="mesh")
        # files give each triangle or patch corners of its own: apart, they would tear when they are simplified
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        faces += len(mesh.faces)
        if not len(mesh.faces) or faces > FACES or not np.isfinite(mesh.vertices).all():
            raise ValueError(f"{path}: none or too many triangles, or corners that are no numbers")
        arrays |= {f"v{index}": np.asarray(mesh.vertices), f"f{index}": np.asarray(mesh.faces)}
    # in memory first: NumPy writes an archive by going back in its file, which a pipe does not allow
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    output.write(buffer.getbuffer())


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]], sys.stdout.buffer)
