"""Visual and collision shapes of links: boxes, cylinders and spheres as numbers, meshes as triangles."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Literal

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from spelgen.urdf import mesh_child
from spelgen.urdf.document import urdf_bytes

Mesh = tuple[np.ndarray, np.ndarray]
PRIMITIVES = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}
"""Attributes of the shapes that are no meshes."""
COUNTS = {"box": 3, "cylinder": 2, "sphere": 1}
"""Numbers in these attributes."""


@dataclass(frozen=True, eq=False)
class LinkShape:
    """A shape of a link.

    kind and size [m]: "box" with three edges, "cylinder" with radius and length along z, "sphere" with its radius,
    "mesh" with the scale along x, y and z. pose: (4, 4), in the frame of the link. file: of a mesh, as named in the
    URDF. mesh: vertices (V, 3) [m], scaled, in the frame of the shape, and triangles (F, 3).
    """

    link: str
    kind: str
    size: tuple[float, ...]
    pose: np.ndarray
    file: str = ""
    mesh: Mesh | None = None


@dataclass(frozen=True, eq=False)
class LinkShapes:
    """The shapes of links that were read, and the unread ones: name of the link -> names of files, or kind."""

    shapes: tuple[LinkShape, ...]
    unread: dict[str, tuple[str, ...]]

    @property
    def unread_text(self) -> str:
        """The links and files of the shapes that were not read; empty without any."""
        return ", ".join(f"{link} ({', '.join(names)})" for link, names in self.unread.items())


def link_shapes(
    urdf: Path, element: Literal["visual", "collision"], links: Sequence[str], faces: int
) -> LinkShapes:
    """Return the visual or collision shapes of links of a valid URDF.

    Args:
        urdf: Path of the file; its folder and the folders above are searched for meshes.
        element: Name of the elements.
        links: Names of the links.
        faces: Largest number of triangles of all meshes together; finer meshes are simplified.
    """
    root = etree.fromstring(urdf_bytes(urdf), etree.XMLParser(resolve_entities=False, no_network=True))
    shapes: list[LinkShape] = []
    unread: dict[str, tuple[str, ...]] = {}
    for link in root.iterfind("link"):
        name = link.get("name", "")
        for each in link.iterfind(element) if name in links else ():
            try:
                shapes.append(_shape(name, each))
            except ValueError as error:
                unread[name] = (*unread.get(name, ()), str(error))
    meshes = _meshes(urdf, [shape for shape in shapes if shape.kind == "mesh"], faces)
    complete: list[LinkShape] = []
    for shape in shapes:
        mesh = meshes.get((shape.file, shape.size))
        if shape.kind == "mesh" and mesh is None:
            unread[shape.link] = (*unread.get(shape.link, ()), shape.file)
        else:
            complete.append(replace(shape, mesh=mesh))
    return LinkShapes(tuple(complete), unread)


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


def _shape(link: str, element: etree._Element) -> LinkShape:
    """Return a shape, a mesh without its triangles. Raises ValueError with the kind of an invalid shape."""
    pose = np.eye(4)
    origin = element.find("origin")
    if origin is not None:
        pose[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), 3)
        pose[:3, :3] = Rotation.from_euler("xyz", _numbers(origin.get("rpy", "0 0 0"), 3)).as_matrix()
    for kind, names in PRIMITIVES.items():
        primitive = element.find(f"geometry/{kind}")
        if primitive is not None:
            size = _numbers(" ".join(primitive.get(name, "") for name in names), COUNTS[kind])
            if min(size) < 0:
                raise ValueError(f"a {kind} of negative size")
            return LinkShape(link, kind, size, pose)
    mesh = element.find("geometry/mesh")
    if mesh is None:
        raise ValueError("no box, cylinder, sphere or mesh")
    return LinkShape(link, "mesh", _numbers(mesh.get("scale", "1 1 1"), 3), pose, mesh.get("filename", ""))


def _numbers(text: str, count: int) -> tuple[float, ...]:
    """Return `count` finite numbers. Raises ValueError."""
    values = tuple(map(float, text.split()))
    if len(values) != count or not all(map(isfinite, values)):
        raise ValueError(f"not {count} numbers: {text!r}")
    return values


def _meshes(urdf: Path, shapes: Sequence[LinkShape], faces: int) -> dict[tuple[str, tuple[float, ...]], Mesh]:
    """Return meshes by file and scale, without unreadable ones."""
    paths: dict[tuple[str, tuple[float, ...]], str] = {}
    for shape in shapes:
        with suppress(FileNotFoundError):
            paths[shape.file, shape.size] = str(mesh_file(urdf, shape.file))
    if not paths:  # a process takes seconds to start
        return {}
    # ASCII JSON on stdin: arguments of a process are limited to the characters of the locale
    meshes = [(path, scale) for (_, scale), path in paths.items()]
    task = json.dumps({"faces": max(1, faces // len(paths)), "meshes": meshes}).encode()
    command = [sys.executable, "-P", "-m", mesh_child.__name__]
    try:
        # a process with limits: a mesh may declare any size, and may name a file without an end
        run = subprocess.run(command, input=task, capture_output=True, timeout=60, check=True)
        arrays = np.load(io.BytesIO(run.stdout))
        numbered = [(key, f"v{index}", f"f{index}") for index, key in enumerate(paths)]
        return {key: (arrays[v], arrays[f]) for key, v, f in numbered if v in arrays}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, subprocess.SubprocessError):
        return {}
