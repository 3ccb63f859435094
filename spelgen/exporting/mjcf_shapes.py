"""Visual and collision shapes of the links of an arm in MJCF."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from lxml import etree

from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.body_regressor import quaternion
from spelgen.dynamics.tip_frame import link_poses
from spelgen.exporting.tuning import TUNING
from spelgen.urdf.geometry import LinkShape, link_shapes

CONTACTS = {
    "visual": {"group": "2", "contype": "0", "conaffinity": "0"},
    "collision": {"group": "3", "contype": "1", "conaffinity": "0"},
}
"""Attributes of geoms by element of the URDF. Links touch other things but not each other, since shapes of neighbours
overlap, and the model has no contacts."""
# Thickness of a mesh, relative to its size, below which MuJoCo refuses it.
FLAT = 1e-5


def add_shapes(root: etree._Element, elements: Sequence[etree._Element], arm: Arm) -> str:
    """Add the shapes of all links to a model.

    Args:
        root: of the model, which gets the meshes.
        elements: of the world and of the bodies, in the order of the arm.
        arm: with the URDF.

    Returns the links with shapes that are omitted, since they cannot be read or are flat; empty without any.
    """
    names = [link.name for link in arm.robot.links]
    assets = etree.SubElement(root, "asset")
    omitted: dict[str, None] = {}
    poses = link_poses(arm)
    for kind, attributes in CONTACTS.items():
        found = link_shapes(
            arm.robot.path, "visual" if kind == "visual" else "collision", names, TUNING.faces
        )
        omitted |= dict.fromkeys(found.unread)
        for shape in found.shapes:
            if shape.mesh is not None and _is_flat(shape.mesh[0]):
                omitted[shape.link] = None
                continue
            carrier, pose = poses[shape.link]
            pose = pose @ shape.pose
            placed = {"pos": _numbers(pose[:3, 3]), "quat": _numbers(quaternion(pose[:3, :3]))}
            form = _form(shape, assets)
            # the <inertial> of the body has the mass
            etree.SubElement(elements[carrier + 1], "geom", form | placed | attributes | {"mass": "0"})
    if not len(assets):
        root.remove(assets)
    return ", ".join(omitted)


def _form(shape: LinkShape, assets: etree._Element) -> dict[str, str]:
    """Return type and size of a geom; a mesh is added to the assets."""
    if shape.mesh is None:
        sizes = {"box": [x / 2 for x in shape.size], "cylinder": [shape.size[0], shape.size[-1] / 2]}
        return {"type": shape.kind, "size": _numbers(sizes.get(shape.kind, shape.size))}
    vertices, faces = shape.mesh
    name = f"mesh{len(assets) + 1}"
    content = {"vertex": _numbers(vertices, ".6g"), "face": _numbers(faces, "d"), "inertia": "shell"}
    etree.SubElement(assets, "mesh", name=name, **content)
    return {"type": "mesh", "mesh": name}


def _is_flat(vertices: np.ndarray) -> bool:
    """True if a mesh with vertices (V, 3) has no convex hull in three dimensions."""
    extents = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    return len(extents) < 3 or bool(extents[2] <= FLAT * extents[0])


def _numbers(values: object, form: str = ".17g") -> str:
    """Return numbers (...,) as text."""
    return " ".join(format(number, form) for number in np.ravel(values).tolist())  # type: ignore[call-overload]
