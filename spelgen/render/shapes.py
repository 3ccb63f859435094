"""Shapes of links as triangles: tubes, and the visual shapes of a URDF."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import numpy as np
from lxml import etree
from pydantic import PlainSerializer, PlainValidator

from spelgen.evaluation.plain import Curve
from spelgen.render import mesh_child

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class Shape:
    """Vertices (V, 3) [m] in the link frame; triangles as vertex indices (F, 3), counterclockwise from outside."""

    vertices: Curve
    faces: Annotated[np.ndarray, PlainValidator(np.array), PlainSerializer(np.ndarray.tolist)]


def joined(meshes: Sequence[Trimesh]) -> Shape:
    """Return one shape with the triangles of all meshes."""
    import trimesh

    if not meshes:
        return Shape(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    mesh = cast("Trimesh", trimesh.util.concatenate(meshes))
    return Shape(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def tube(start: np.ndarray, end: np.ndarray, radius: float, sides: int = 10) -> list[Trimesh]:
    """Return a closed prism, or nothing if it would be shorter than half its radius.

    Args:
        start: First end of the axis, (3,) [m].
        end: Last end of the axis, (3,) [m].
        radius: Radius of the circumscribed cylinder [m].
        sides: Number of sides.
    """
    import trimesh

    if np.linalg.norm(end - start) <= radius / 2:
        return []
    return [trimesh.creation.cylinder(radius, segment=[start, end], sections=sides)]


def visual_shapes(urdf: Path, links: Sequence[str]) -> dict[str, Shape]:
    """Return the simplified visual shapes of these links; an empty dict if any mesh cannot be read."""
    command = [sys.executable, "-P", "-m", mesh_child.__name__]
    shapes = {}
    try:
        if not _any_visual(urdf, links):  # a process takes seconds to start
            return {}
        # ASCII JSON on stdin: arguments of a process are limited to the characters of the locale
        names = json.dumps([str(urdf), *links]).encode()
        # a process with limits: a mesh may declare any size, and may name a file without an end
        run = subprocess.run(command, input=names, capture_output=True, timeout=60, check=True)
        arrays = np.load(io.BytesIO(run.stdout))
        for index, name in enumerate(links):
            if f"v{index}" in arrays:
                shapes[name] = Shape(arrays[f"v{index}"], arrays[f"f{index}"])
    except (OSError, ValueError, EOFError, etree.LxmlError, zipfile.BadZipFile, subprocess.SubprocessError):
        return {}  # the page shows tubes
    return shapes


def _any_visual(urdf: Path, links: Sequence[str]) -> bool:
    """Return True if any of these links has a visual shape. Raises FileNotFoundError if a mesh is not found."""
    root = etree.fromstring(urdf.read_bytes(), etree.XMLParser(resolve_entities=False, no_network=True))
    elements = [link for link in root.iterfind("link") if link.get("name") in links]
    for link in elements:
        for mesh in link.iterfind("visual/geometry/mesh"):
            mesh_child.mesh_file(urdf, mesh.get("filename", ""))
    return any(link.find("visual") is not None for link in elements)
