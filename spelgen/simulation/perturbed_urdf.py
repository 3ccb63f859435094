"""URDFs with perturbed inertials: those of another, physically consistent arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from lxml import etree

from spelgen.urdf.document import urdf_bytes

MASSLESS = 1e-9
"""Links of at most this mass [kg] are placeholders and stay unchanged."""
MIN_SPREAD = 0.01
"""Smallest principal second moment of mass, relative to the largest, that replaces a negative one."""


def perturbed_urdf(robot: Path, error: float, seed: int) -> bytes:
    """Return the URDF without friction, visuals and collisions, and with perturbed inertials.

    Per link, mass and inertia about the centre of mass are scaled by independent factors exp(error N(0, 1)); the centre
    of mass is shifted by error N(0, 1) times the body's radius of gyration, along each axis of the link frame. An
    inertia tensor that no body can have is replaced by a physically consistent one.

    Args:
        robot: URDF or xacro file, which was read before.
        error: Relative standard deviation: 0.3 is 30 %.
        seed: Seed of the random factors; the same seed gives the same bytes.
    """
    parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True)
    tree = etree.ElementTree(etree.fromstring(urdf_bytes(robot), parser))
    for element in list(tree.iter("dynamics", "visual", "collision")):
        element.getparent().remove(element)
    rng = np.random.default_rng(seed)
    for inertial in tree.iterfind(".//link/inertial"):
        _perturb(inertial, error * rng.normal(size=2), error * rng.normal(size=3))
    text: bytes = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    return text


def _perturb(inertial: etree._Element, log_factors: np.ndarray, displacement: np.ndarray) -> None:
    """Scale mass and inertia of an <inertial> and shift its centre of mass.

    Args:
        inertial: The element, changed in place.
        log_factors: (2,) logarithms of the factors of the mass and of the inertia per mass.
        displacement: (3,) shift of the centre of mass, relative to the radius of gyration.
    """
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or float(mass.get("value", "0")) <= MASSLESS:
        return
    mass_factor, inertia_factor = np.exp(log_factors).tolist()
    kilograms, trace = float(mass.get("value")), 0.0
    mass.set("value", repr(mass_factor * kilograms))
    if tensor is not None:
        _make_consistent(tensor)
        trace = sum(float(tensor.get(name, "0")) for name in ("ixx", "iyy", "izz"))
        for name, value in tensor.attrib.items():
            tensor.set(name, repr(mass_factor * inertia_factor * float(value)))
    gyration_radius = np.sqrt(max(trace, 0.0) / 2 / kilograms)
    origin = inertial.find("origin")
    if origin is None:
        origin = etree.SubElement(inertial, "origin")
    center = np.array(origin.get("xyz", "0 0 0").split(), dtype=float)
    origin.set("xyz", " ".join(map(repr, (center + gyration_radius * displacement).tolist())))


def _make_consistent(tensor: etree._Element) -> None:
    """Replace an inertia tensor that violates the triangle inequality: clip its second moments of mass.

    The second moments are S = trace(I)/2 1 - I; a body has S >= 0 (Wensing, Kim, Slotine, IEEE RA-L 3:60, 2018).
    """
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    upper = np.triu_indices(3)
    inertia = np.zeros((3, 3))
    inertia[upper] = [float(tensor.get(name, "0")) for name in names]
    inertia = inertia + np.triu(inertia, 1).T
    moments, axes = np.linalg.eigh(np.trace(inertia) / 2 * np.eye(3) - inertia)
    if moments.min() >= -1e-9 * np.abs(moments).max():
        return
    second = (axes * np.maximum(moments, MIN_SPREAD * np.abs(moments).max())) @ axes.T
    inertia = np.trace(second) * np.eye(3) - second
    for name, value in zip(names, inertia[upper].tolist(), strict=True):
        tensor.set(name, repr(value))
