"""Visual and collision shapes of the links of a URDF: sizes of boxes, cylinders and spheres, triangles of meshes."""

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
from spelgen.urdf.document import read_document

Mesh = tuple[np.ndarray, np.ndarray]
COUNTS = {"box": 3, "cylinder": 2, "sphere": 1, "mesh": 3}
"""Number of values in the size of each kind of shape."""


@dataclass(frozen=True, eq=False)
class LinkShape:
    """A shape of a link.

    Attributes:
        link: name of the link.
        kind, size: "box" with the lengths of three edges, "cylinder" with radius and length along z, "sphere" with
            radius [m], "mesh" with the scale factors along x, y and z.
        pose: homogeneous transform (4, 4) of the shape in the frame of the link.
        file: name of the file of a mesh in the URDF.
        mesh: scaled vertices (V, 3) [m] of a mesh in the frame of the shape, and vertex indices (F, 3) of the
            triangles, with V vertices and F triangles; None for other kinds.
    """

    link: str
    kind: str
    size: tuple[float, ...]
    pose: np.ndarray
    file: str = ""
    mesh: Mesh | None = None


class LinkShapes(NamedTuple):
    """The shapes that were read, and the shapes that could not be read.

    unread: {name of a link: a text for each of its unread shapes}. The text is the name of the mesh file, or the reason
    for which the shape could not be read.
    """

    shapes: tuple[LinkShape, ...]
    unread: dict[str, tuple[str, ...]]

    @property
    def unread_text(self) -> str:
        """Text that lists the links with unread shapes: the first two with their files, and the number of others."""
        named = [f"{link} ({', '.join(names)})" for link, names in self.unread.items()]
        if len(named) > 2:
            named[2:] = [counted(len(named) - 2, "more link")]
        return ", ".join(named)


def link_shapes(
    urdf: Path, element: Literal["visual", "collision"], links: Sequence[str], faces: int
) -> LinkShapes:
    """Return the visual or collision shapes of links of a valid URDF.

    Args:
        urdf: Path of the URDF; its folder and all parent folders are searched for meshes.
        element: Elements to read, "visual" or "collision".
        links: Names of the links whose shapes are returned.
        faces: Largest number of triangles of all meshes together; a mesh is simplified to this number divided by the
            number of meshes.
    """
    shapes: list[LinkShape] = []
    unread: dict[str, tuple[str, ...]] = {}
    for link in read_document(urdf).root.iterfind("link"):
        name = link.get("name", "")
        for each in link.iterfind(element) if name in links else ():
            # Shapes are needed for drawings only: an invalid shape is listed as unread, and the others are returned.
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
    """Return the path of a mesh from its name in the URDF. Raises FileNotFoundError if no such file exists.

    The folder of the URDF and all its parent folders are searched, because any of them may be a package folder.
    """
    scheme, _, path_text = name.rpartition("://")
    path = Path(path_text)
    inner = Path(*path.parts[scheme == "package" :])
    for file in (urdf.parent / inner, path, *(folder / inner for folder in urdf.parents)):
        # Unlike Path.is_file, os.path.isfile raises no error for an invalid name.
        if os.path.isfile(file):
            return file
    raise FileNotFoundError(name)


def _shape(link: str, element: etree._Element) -> LinkShape:
    """Return the shape of a <visual> or <collision> element, read by yourdfpy. Raises ValueError if it is invalid.

    link: name of the link. The triangles of a mesh are not read here, but later for all meshes by `_meshes`.
    """
    import yourdfpy  # yourdfpy is imported here, because it imports trimesh, which takes long.

    # Each shape is parsed as a URDF of its own, so that an invalid shape does not affect the others.
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
    except Exception as error:  # yourdfpy raises errors of many types, so all are caught.
        raise ValueError("a shape that is not valid") from error
    if not (np.isfinite(pose).all() and np.isfinite(numbers).all()) or (kind != "mesh" and numbers.min() < 0):
        raise ValueError(f"a {kind} of negative or infinite size or place")
    return LinkShape(link, kind, tuple(numbers.tolist()), pose, file_name or "")


def _meshes(urdf: Path, shapes: Sequence[LinkShape], faces: int) -> dict[tuple[str, tuple[float, ...]], Mesh]:
    """Return {(file, scale): mesh} of the shapes that are meshes; a mesh that cannot be read is omitted.

    faces: limit of the number of triangles of all meshes together; a mesh of more than `faces` divided by the number of
    shapes is simplified.
    """
    paths: dict[tuple[str, tuple[float, ...]], str] = {}
    for shape in shapes:
        with suppress(FileNotFoundError):
            paths[shape.file, shape.size] = str(mesh_file(urdf, shape.file))
    # The process that reads meshes is started only if there are meshes, because its start takes seconds.
    if not paths:
        return {}
    # The list of meshes is passed as ASCII JSON on stdin and not as arguments, because the locale limits the characters
    # of arguments.
    meshes = [(path, scale) for (_, scale), path in paths.items()]
    task = json.dumps({"faces": max(1, faces // len(shapes)), "meshes": meshes}).encode()
    command = [sys.executable, "-P", "-m", mesh_child.__name__]
    try:
        # Meshes are read in a process with limits: a mesh file may declare any size, or name an endless file.
        run = subprocess.run(command, input=task, capture_output=True, timeout=60, check=True)
        arrays = np.load(io.BytesIO(run.stdout))
        numbered = [(key, f"v{index}", f"f{index}") for index, key in enumerate(paths)]
        return {key: (arrays[v], arrays[f]) for key, v, f in numbered if v in arrays}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, subprocess.SubprocessError):
        return {}
