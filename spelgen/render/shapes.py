"""Shapes of links as triangles: tubes of our own, and what a URDF shows of its links."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from lxml import etree
from pydantic import PlainSerializer, PlainValidator

from spelgen.evaluation.plain import Curve
from spelgen.render import mesh_child

if TYPE_CHECKING:
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


def visual_shapes(urdf: Path, links: Sequence[str]) -> dict[str, Shape]:
    """Return what the URDF shows of these links, simplified to fit a page; nothing where a mesh is not found."""
    command = [sys.executable, "-P", "-m", mesh_child.__name__]
    shapes = {}
    try:
        if not _are_visuals_there(urdf, links):  # a process takes seconds to start
            return {}
        # as JSON, which is ASCII: arguments may hold no name that the locale has no letters for
        names = json.dumps([str(urdf), *links]).encode()
        # a file may say that it is a thousand times as large as it is, or name one that never ends
        run = subprocess.run(command, input=names, capture_output=True, timeout=60, check=True)
        arrays = np.load(io.BytesIO(run.stdout))
        for index, name in enumerate(links):
            if f"v{index}" in arrays:
                shapes[name] = Shape(arrays[f"v{index}"], arrays[f"f{index}"])
    except (OSError, ValueError, EOFError, etree.LxmlError, zipfile.BadZipFile, subprocess.SubprocessError):
        return {}  # the page stands without
    return shapes


def _are_visuals_there(urdf: Path, links: Sequence[str]) -> bool:
    """Return whether a URDF shows any of these links. Raises FileNotFoundError where a mesh is missing."""
    root = etree.fromstring(urdf.read_bytes(), etree.XMLParser(resolve_entities=False, no_network=True))
    shown = [link for link in root.iterfind("link") if link.get("name") in links]
    for link in shown:
        for mesh in link.iterfind("visual/geometry/mesh"):
            mesh_child.mesh_file(urdf, mesh.get("filename", ""))
    return any(link.find("visual") is not None for link in shown)
