"""Export with ``--to urdf``: the URDF and the settings with trained parameters, and the friction model."""

import numpy as np
import numpy.typing as npt
import yaml
from lxml import etree

from spelgen.arm.arm import lump_links
from spelgen.arm.chain import choose_chain
from spelgen.dynamics.body_regressor import about_center
from spelgen.dynamics.parameters import friction_factor
from spelgen.exporting.describe import Trained, array
from spelgen.exporting.exported import Exported, with_readme
from spelgen.exporting.rigid_body_projection import (
    RigidBodyProjection,
    rigid_body_projection,
    sampled_positions,
)
from spelgen.urdf.document import read_document

_LAW = (
    "factor (viscous qd + saturation s(qd, saturation_velocity) + dry direction), with "
    "s(x, w) = x / sqrt(x^2 + w^2); "
    "dry = coulomb + stribeck / (1 + (1 + r) v^2 / (v + r) / 8)^8 + "
    "load_dependence sqrt(gravity torque^2 + min_load^2), v = |qd| / stribeck_velocity, r = stribeck_rounding; "
    "direction = memoryless s(qd, coulomb_smoothing_velocity) + sum of bristle_fractions z / bristle_reach, with "
    "the deflections z of the bristles: z' = qd, limited to |z| <= bristle_reach; "
    "factor = 1, or a function of the joint's position with the range position_factor"
)
_SERVO = "clip(kp d - kd qd, -limit, limit), with d = u - q less the dead zone, and u the command `delay` [s] earlier"


def export_urdf(trained: Trained) -> Exported:
    """Return a trained model as three files with a README: the URDF, the settings, and the friction model."""
    projection = rigid_body_projection(trained.model, trained.arm)
    use = (
        "The .urdf contains inertials, viscous and Coulomb friction, which simulators ignore; the .yaml beside it, "
        "which spelgen reads, rotor inertia and friction in both directions; .urdf.friction.yaml the model's own law."
    )
    about = "the link that a joint moves has the inertial of the whole body."
    files = {
        ".urdf": _urdf_text(projection),
        ".yaml": _settings_text(projection).encode(),
        ".urdf.friction.yaml": _friction_text(trained, projection).encode(),
    }
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
    chain = choose_chain(robot, arm.joint_names, None)
    lumped = lump_links(robot, chain, projection.arm.angle_tolerance)
    for body, inertia in zip(lumped.moved, projection.inertias, strict=True):
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
    path = projection.arm.robot.path.with_suffix(".yaml")
    content: dict[str, dict[str, dict[str, object]]] = {}
    # The user's settings file of the arm is copied, with new rotor inertias and friction.
    if path.exists():
        content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    joints = content.setdefault("joints", {})
    friction = projection.friction
    for index, coordinate in enumerate(projection.arm.chain.coordinates):
        # The settings specify the inertia at the rotor; the model has the inertia at the joint, gear^2 times
        # as large.
        gear = projection.arm.settings.joint(coordinate.name).gear
        joint = joints.setdefault(coordinate.name, {})
        joint["rotor_inertia"] = _plain(projection.armature[index] / gear**2)
        joint["viscous"] = _plain(friction.viscous[index])
        joint["coulomb"] = _plain([friction.forward[index], friction.backward[index]])
    return str(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


def _friction_text(trained: Trained, projection: RigidBodyProjection) -> str:
    """Return YAML text: per joint, viscous and Coulomb friction and the constants of friction model and servo."""
    content: dict[str, object] = {
        "units": "Nm, Nm s/rad and rad/s of revolute joints; N, N s/m and m/s of prismatic ones",
        "viscous_coulomb": "viscous qd + coulomb[0] where qd > 0, + coulomb[1] where qd < 0",
    }
    coulomb = np.stack([projection.friction.forward, projection.friction.backward], axis=1)
    # `sections`: {section: {name: array (n,), or (n, K) with K values per joint}}.
    sections = {"viscous_coulomb": {"viscous": projection.friction.viscous, "coulomb": coulomb}}
    # Only rigid-body models have a friction model with constants; others have friction networks.
    if projection.exact:
        content["law"] = _LAW
        sections["law"] = _law_constants(trained, projection)
    servos = projection.servos
    if servos is not None:
        content |= {"servo": _SERVO, "delay": _plain(servos.delay)}
        gains = {"kp": servos.kp, "kd": servos.kd, "limit": servos.limit, "dead_zone": servos.dead_zone}
        sections["servo"] = gains
    joints: dict[str, dict[str, object]] = {}
    for index, name in enumerate(trained.arm.chain.joint_names):
        joints[name] = {}
        for section, constants in sections.items():
            joints[name][section] = {key: _plain(values[index]) for key, values in constants.items()}
    content["joints"] = joints
    return str(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


def _law_constants(trained: Trained, projection: RigidBodyProjection) -> dict[str, np.ndarray]:
    """Return {name: constants of a model's friction law in SI units}: (n,), or (n, K) for K values per joint.

    The names are the fields of ``FrictionConstants``, and ``position_factor``, (n, 2): minimum and maximum of the
    factor by which residual terms multiply the friction, over the joint ranges of the arm in `projection`.
    """
    model = trained.model
    constants = {name: array(value) for name, value in model.friction.prepare()._asdict().items()}
    factor = array(friction_factor(model, sampled_positions(projection.arm.chain)))
    # The position-dependent friction factor is given by its minimum and maximum, and omitted if it is one everywhere.
    if (factor != 1).any():
        constants["position_factor"] = np.stack([factor.min(axis=0), factor.max(axis=0)], axis=-1)
    return constants


def _plain(value: npt.ArrayLike) -> object:
    """Return a number, or an array as nested lists, rounded to twelve digits, more than any fit determines."""
    rounded = np.vectorize(lambda x: float(_number(x)), otypes=[float])
    return rounded(value).tolist()


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
    return f"{value:.12g}"
