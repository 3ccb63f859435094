"""Constants of the reader of meshes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeshTuning:
    """Limits of the process that reads meshes."""

    # [bytes] Memory of the process that reads meshes.
    mesh_memory: int = 2**30
    # [s] Processor time of the process that reads meshes: imports and the simplification of meshes take most of it.
    mesh_seconds: int = 30
    # [bytes] Largest file with a mesh.
    max_mesh_bytes: int = 50_000_000
    # [1] Largest number of faces of a mesh: archives may expand without end.
    max_mesh_faces: int = 2_000_000


TUNING = MeshTuning()
