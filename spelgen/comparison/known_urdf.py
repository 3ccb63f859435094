"""URDF that the models of a simulated comparison are built from: kinematics without inertials, or wrong inertials."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from lxml import etree

from spelgen.comparison.tuning import ComparisonTuning

TUNING = ComparisonTuning()


def known_urdf(robot: Path, error: float | None) -> bytes:
    """Return a URDF without friction, and without inertials (error: None) or with disturbed ones.

    Mass and inertia of each link are multiplied by exp(error N(0, 1)), so 0.3 is about 30 % and 1 a factor of e; the
    centre of mass is shifted by error N(0, 1) times the body's radius of gyration along each axis. Disturbed inertials
    are physically consistent and the same in every call.
    """
    # `load_arm` has read this file, so its size and entities have been checked
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


def _disturb(inertial: etree._Element, logarithms: np.ndarray, shift: np.ndarray) -> None:
    """Multiply mass and inertia by exp(logarithms) (2,), and shift the centre of mass.

    shift: (3,), in units of the radius of gyration.
    """
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or tensor is None or float(mass.get("value", "0")) <= TUNING.massless:
        return
    mass_factor, inertia_factor = np.exp(logarithms).tolist()
    kilograms = float(mass.get("value"))
    trace = sum(float(tensor.get(name, "0")) for name in ("ixx", "iyy", "izz"))
    radius = np.sqrt(max(trace, 0.0) / 2 / kilograms)
    mass.set("value", repr(mass_factor * kilograms))
    for name, value in tensor.attrib.items():
        tensor.set(name, repr(mass_factor * inertia_factor * float(value)))
    origin = inertial.find("origin")
    if origin is None:
        origin = etree.SubElement(inertial, "origin")
    center = np.array(origin.get("xyz", "0 0 0").split(), dtype=float)
    origin.set("xyz", " ".join(map(repr, (center + radius * shift).tolist())))
