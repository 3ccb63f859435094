"""Export with ``--to urdf``: the URDF and the settings with trained parameters."""

import numpy as np
import yaml
from lxml import etree

from spelgen.arm.arm import lump_links
from spelgen.arm.chain import choose_chain
from spelgen.dynamics.body_regressor import about_center
from spelgen.exporting.describe import Trained
from spelgen.exporting.exported import Exported, with_readme
from spelgen.exporting.rigid_body_projection import RigidBodyProjection, rigid_body_projection
from spelgen.urdf.document import read_document


def export_urdf(trained: Trained) -> Exported:
    """Return a trained model as two files with a README: the URDF and the settings."""
    projection = rigid_body_projection(trained.model, trained.arm)
    use = (
        "The .urdf contains inertials, viscous and Coulomb friction, which simulators ignore; the .yaml beside it, "
        "which spelgen reads, rotor inertia and friction in both directions."
    )
    about = "the link that a joint moves has the inertial of the whole body."
    files = {".urdf": _urdf_text(projection), ".yaml": _settings_text(projection).encode()}
    return with_readme(trained, "urdf", files, use=use, about=about, summary=projection.summary)


def _urdf_text(projection: RigidBodyProjection) -> bytes:
    """Return the content of the arm's URDF with the inertials and the friction of the model.

    A body may consist of several links with fixed joints. The child link of its moving joint gets the <inertial> of the
    whole body; the <inertial> of its other links is removed.
    """
    robot = projection.arm.robot
    arm = projection.arm.chain
    root = read_document(robot.path).root
    links = {element.get("name"): element for element in root.findall("link")}
    joints = {element.get("name"): element for element in root.findall("joint")}
    lumped = lump_links(robot, choose_chain(robot, arm.joint_names, None), projection.arm.angle_tolerance)
    for body, inertia in zip(lumped.moved, projection.bodies.inertial_parameters.numpy(), strict=True):
        for link in body.links:
            etree.strip_elements(links[link.name], "inertial")
        name = body.joint.child
        # `rotation` maps from the body frame, whose z axis is the joint axis, to the link frame.
        rotation = np.array(lumped.frames[name].rotation.T, dtype=float)
        mass, center, tensor = about_center(inertia)
        # Some tools do not read the orientation of an <inertial>, so the tensor has the axes of the link.
        links[name].insert(0, _inertial(mass, rotation @ center, rotation @ tensor @ rotation.T))
    friction = projection.friction
    for index, coordinate in enumerate(arm.coordinates):
        element = joints[coordinate.name]
        # Existing <dynamics> of a joint are removed: with two of them, some tools read the first and some the last.
        etree.strip_elements(element, "dynamics")
        values = {"damping": _number(friction.viscous[index]), "friction": _number(friction.coulomb[index])}
        etree.SubElement(element, "dynamics", values)
    return bytes(etree.tostring(root, xml_declaration=True, encoding="utf-8")) + b"\n"


def _settings_text(projection: RigidBodyProjection) -> str:
    """Return the arm's settings as YAML with the rotor inertia and the friction of the model."""
    arm, path = projection.arm, projection.arm.robot.path.with_suffix(".yaml")
    # The user's settings file of the arm is copied, with new rotor inertias and friction.
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    content = yaml.safe_load(text) or {}
    # The chain may have been chosen on the command line; settings may contain either of these keys, but not both.
    content |= {"tip": arm.tip} if arm.tip else {"moving_joints": list(arm.chain.joint_names)}
    content.pop("moving_joints" if arm.tip else "tip", None)
    joints = content.setdefault("joints", {})
    friction, armature = projection.friction, projection.bodies.armature.tolist()
    for index, coordinate in enumerate(arm.chain.coordinates):
        # The settings specify the inertia at the rotor; the model has the inertia at the joint, gear^2 times
        # as large.
        rotor = armature[index] / arm.settings.joint(coordinate.name).gear ** 2
        numbers = rotor, friction.viscous[index], friction.forward[index], friction.backward[index]
        rotor, viscous, *coulomb = (float(_number(number)) for number in numbers)
        values = {"rotor_inertia": rotor, "viscous": viscous, "coulomb": coulomb}
        joints.setdefault(coordinate.name, {}).update(values)
    return str(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


def _inertial(mass: float, center: np.ndarray, tensor: np.ndarray) -> etree._Element:
    """Return the <inertial> of a link.

    Args:
        mass: mass [kg].
        center: centre of mass in the link frame, (3,) [m].
        tensor: inertia about the centre of mass along the axes of the link frame, (3, 3) [kg m^2].
    """
    inertial = etree.Element("inertial")
    etree.SubElement(inertial, "origin", xyz=" ".join(map(_number, center)), rpy="0 0 0")
    etree.SubElement(inertial, "mass", value=_number(mass))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = map(_number, tensor[np.triu_indices(3)])
    etree.SubElement(inertial, "inertia", dict(zip(names, moments, strict=True)))
    return inertial


def _number(value: float) -> str:
    """Return a number as text with twelve digits, more than any fit determines."""
    return f"{value:.12g}"
