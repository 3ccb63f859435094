"""What models of a comparison know of the simulated robot: its kinematics alone, or inertials that are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from lxml import etree

from spelgen.settings.tuning.comparison import ComparisonTuning

TUNING = ComparisonTuning()


def without_inertials(robot: Path) -> bytes:
    """Return the URDF with nothing but kinematics and limits."""
    return _written(_plain(robot, ("inertial", "dynamics", "visual", "collision")))


def with_wrong_inertials(robot: Path, error: float) -> bytes:
    """Return the URDF without friction, whose bodies are other possible ones.

    Mass, size of the inertia about the centre of mass, and the place of that (relative to the body's own size) err by
    this standard deviation.

    Masses and inertias by factors exp(error N(0, 1)): 0.3 is 30 %, 1 a factor of e; drawn anew for each link, the same
    ones in every call.
    """
    tree, rng = _plain(robot, ("dynamics", "visual", "collision")), np.random.default_rng(TUNING.seed)
    for inertial in tree.findall(".//link/inertial"):
        by_mass, by_inertia = np.exp(error * rng.normal(size=2))
        moved = error * rng.normal(size=3)
        mass, tensor = inertial.find("mass"), inertial.find("inertia")
        kilograms = 0.0 if mass is None else float(mass.get("value", "0"))
        if mass is None or tensor is None or kilograms <= TUNING.massless:
            continue
        trace = sum(float(tensor.get(name, "0")) for name in ("ixx", "iyy", "izz"))
        size = np.sqrt(max(trace, 0.0) / 2 / kilograms)  # about that of the body
        mass.set("value", repr(float(by_mass * kilograms)))
        for name, value in tensor.attrib.items():
            tensor.set(name, repr(float(by_mass * by_inertia * float(value))))
        origin = inertial.find("origin")
        if origin is None:
            origin = etree.SubElement(inertial, "origin")
        center = list(map(float, origin.get("xyz", "0 0 0").split()))
        origin.set("xyz", " ".join(repr(float(x)) for x in np.add(center, size * moved)))
    return _written(tree)


def _plain(robot: Path, left_out: tuple[str, ...]) -> etree._ElementTree:
    """Return the URDF without these elements; it was read before, so it is known to be harmless."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True)
    tree = etree.ElementTree(etree.fromstring(robot.read_bytes(), parser))
    for name in left_out:
        for element in tree.findall(f".//{name}"):
            element.getparent().remove(element)
    return tree


def _written(tree: etree._ElementTree) -> bytes:
    text: bytes = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    return text
