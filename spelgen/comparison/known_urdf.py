"""What models of a comparison know of the simulated robot: its kinematics alone, or inertials that are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from lxml import etree

from spelgen.comparison.tuning import TUNING


def known_urdf(robot: Path, error: float | None) -> bytes:
    """Return the URDF without friction, and with inertials of other possible bodies; None: without inertials.

    Mass, size of the inertia about the centre of mass, and the place of that (relative to the body's own size) err by
    this standard deviation.

    Masses and inertias by factors exp(error N(0, 1)): 0.3 is 30 %, 1 a factor of e; drawn anew for each link, the same
    ones in every call.
    """
    # it was read before, so it is known to be harmless
    parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True)
    tree = etree.ElementTree(etree.fromstring(robot.read_bytes(), parser))
    removed = ["dynamics", "visual", "collision"]
    if error is None:
        removed.append("inertial")
    for element in list(tree.iter(*removed)):
        element.getparent().remove(element)
    if error is not None:
        rng = np.random.default_rng(TUNING.seed)
        for inertial in tree.iterfind(".//link/inertial"):
            _disturb(inertial, error * rng.normal(size=2), error * rng.normal(size=3))
    text: bytes = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    return text


def _disturb(inertial: etree._Element, logarithms: np.ndarray, displacement: np.ndarray) -> None:
    """Change an inertial by factors of its mass and inertia, and by a displacement relative to the body's size."""
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or tensor is None or float(mass.get("value", "0")) <= TUNING.massless:
        return
    by_mass, by_inertia = np.exp(logarithms).tolist()
    kilograms = float(mass.get("value"))
    trace = sum(float(tensor.get(name, "0")) for name in ("ixx", "iyy", "izz"))
    size = np.sqrt(max(trace, 0.0) / 2 / kilograms)  # about that of the body
    mass.set("value", repr(by_mass * kilograms))
    for name, value in tensor.attrib.items():
        tensor.set(name, repr(by_mass * by_inertia * float(value)))
    origin = inertial.find("origin")
    if origin is None:
        origin = etree.SubElement(inertial, "origin")
    center = np.array(origin.get("xyz", "0 0 0").split(), dtype=float)
    origin.set("xyz", " ".join(map(repr, (center + size * displacement).tolist())))
