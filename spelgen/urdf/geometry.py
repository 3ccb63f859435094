"""Visual and collision shapes of links: boxes, cylinders and spheres as numbers, meshes as triangles."""

import copy
import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from lxml import etree

from spelgen.labels import counted
from spelgen.urdf import mesh_child
from spelgen.urdf.document import urdf_bytes

Mesh = tuple[np.ndarray, np.ndarray]
COUNTS = {"box": 3, "cylinder": 2, "sphere": 1, "mesh": 3}
"""Numbers of the size of each shape."""


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


class LinkShapes(NamedTuple):
    """The shapes that were read. unread: link -> the other shapes, each a mesh file or the kind of a shape."""

    shapes: tuple[LinkShape, ...]
    unread: dict[str, tuple[str, ...]]

    @property
    def unread_text(self) -> str:
        """The first two links and files of the shapes that were not read, and the number of others; empty if none."""
        named = [f"{link} ({', '.join(names)})" for link, names in self.unread.items()]
        if len(named) > 2:
            named[2:] = [counted(len(named) - 2, "more link")]
        return ", ".join(named)


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
            # one invalid shape must not hide the others, which are only drawn
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
    """Return a shape as read by yourdfpy, a mesh without its triangles. Raises ValueError for an invalid shape."""
    import yourdfpy  # imports trimesh, which takes long

    # a file of one shape: an invalid shape does not affect the others
    root = etree.Element("robot", name=link)
    collision = etree.SubElement(etree.SubElement(root, "link", name=link), "collision")
    collision.extend(copy.deepcopy(child) for child in element if child.tag in ("origin", "geometry"))
    try:
        file = io.BytesIO(etree.tostring(root))
        model = yourdfpy.URDF.load(file, build_scene_graph=False, load_meshes=False)
        (shape,) = model.robot.links[0].collisions
        geometry = shape.geometry
        pose = np.eye(4) if shape.origin is None else np.asarray(shape.origin)
        kind, file_name = "mesh", ""
        if geometry.box is not None:
            kind, size = "box", geometry.box.size
        elif geometry.cylinder is not None:
            kind, size = "cylinder", (geometry.cylinder.radius, geometry.cylinder.length)
        elif geometry.sphere is not None:
            kind, size = "sphere", geometry.sphere.radius
        else:
            scale, file_name = geometry.mesh.scale, geometry.mesh.filename
            size = 1.0 if scale is None else scale
        numbers = np.broadcast_to(np.asarray(size, dtype=float), COUNTS[kind])
    except Exception as error:  # of any type, from attributes that are absent or are not numbers
        raise ValueError("a shape that is not valid") from error
    if not (np.isfinite(pose).all() and np.isfinite(numbers).all()) or (kind != "mesh" and numbers.min() < 0):
        raise ValueError(f"a {kind} of negative or infinite size or place")
    return LinkShape(link, kind, tuple(numbers.tolist()), pose, file_name or "")


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
    task = json.dumps({"faces": max(1, faces // len(shapes)), "meshes": meshes}).encode()
    command = [sys.executable, "-P", "-m", mesh_child.__name__]
    try:
        # a process with limits: a mesh may declare any size, and may name a file without an end
        run = subprocess.run(command, input=task, capture_output=True, timeout=60, check=True)
        arrays = np.load(io.BytesIO(run.stdout))
        numbered = [(key, f"v{index}", f"f{index}") for index, key in enumerate(paths)]
        return {key: (arrays[v], arrays[f]) for key, v, f in numbered if v in arrays}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, subprocess.SubprocessError):
        return {}
