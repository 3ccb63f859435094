"""Export with ``--to mjcf``: a file for MuJoCo, whose dynamics in MuJoCo are compared with the model."""

import copy
from collections.abc import Sequence
from typing import Literal

import mujoco
import numpy as np
import torch
from lxml import etree

from spelgen.arm.arm import Chain, Coordinate
from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.body_regressor import about_center, quaternion
from spelgen.dynamics.protocol import motors_of
from spelgen.dynamics.regressor_dynamics import body_chain
from spelgen.dynamics.tip_frame import body_constraint, link_poses, tip_frame
from spelgen.exporting.describe import Servos, Trained
from spelgen.exporting.exported import Exported, with_readme
from spelgen.exporting.parity import Parity, Values, random_inputs, relative, require_parity
from spelgen.exporting.rigid_body_projection import RigidBodyProjection, rigid_body_projection
from spelgen.exporting.tuning import TUNING
from spelgen.urdf.geometry import LinkShape, link_shapes

_SECTIONS = ("worldbody", "equality", "tendon", "actuator", "asset")
_CONTACTS: dict[Literal["visual", "collision"], dict[str, str]] = {
    "visual": {"group": "2", "contype": "0", "conaffinity": "0"},
    "collision": {"group": "3", "contype": "1", "conaffinity": "0"},
}
"""{element of the URDF: attributes of its geom}.

Links have contacts with other objects but not with each other, since shapes of neighbouring links overlap.
"""


def export_mjcf(trained: Trained) -> Exported:
    """Return the MJCF file of a trained model with a README, checked in MuJoCo.

    If the model computes M by networks, the file has the rigid bodies that approximate it best (see
    `rigid_body_projection`). Raises RunError if M, bias or forward dynamics of MuJoCo differ from these rigid bodies.
    """
    # MuJoCo simulates rigid bodies only, so residual terms are omitted and networks are projected onto rigid
    # bodies.
    projection = rigid_body_projection(trained.model, trained.arm)
    text, omitted = mjcf_text(projection)
    parity = check_mjcf(text, projection)
    checked = f"Checked when exported, by MuJoCo {mujoco.__version__}, friction apart: {parity.summary}"
    actuators = "a motor for each input."
    servos = projection.servos
    if servos is not None:
        actuators = (
            f"a position actuator for each servo. Give ctrl the command of {servos.delay:.4g} s before."
        )
        if servos.dead_zone.any():
            actuators += " The servos' dead zones are left out: MuJoCo's position actuators have none."
    use = (
        "mujoco.MjModel.from_xml_path(FILE.xml): bodies by the names of the links that their joints move, armature, "
        f"viscous friction as damping and Coulomb friction as frictionloss, {actuators}"
    )
    about = (
        "a body's frame has its joint's axis as z; the tip is a site; links touch other things, not each other; torque "
        "offsets of the sensors are left out."
    )
    shapes = [f"shapes omitted, since they cannot be read or are flat: {omitted}"] if omitted else []
    summary = [*projection.summary, *shapes, checked]
    return with_readme(trained, "mjcf", {".xml": text}, use=use, about=about, summary=summary)


def check_mjcf(text: bytes, projection: RigidBodyProjection, states: int = TUNING.states) -> Parity:
    """Compare MuJoCo's simulation of an MJCF file with the exported rigid bodies; return the differences.

    M, bias and frictionless forward dynamics are compared at random states. The inputs of the actuators are torques, or
    commands of position servos. Raises RunError if a difference is too large.

    Args:
        text: content of the MJCF file.
        projection: rigid bodies and friction of the model.
        states: number of random states.
    """
    arm, servos = projection.arm.chain, projection.servos
    random = random_inputs(arm.coordinates, states)
    controls = torques = random["tau"]
    if servos is not None:
        # The reference torques are computed without the dead zone of the servos: MuJoCo's position actuators have none.
        controls = random["u"]
        torques = servos.kp * (controls - random["q"]) - servos.kd * random["qd"]
        torques = np.clip(torques, -servos.limit, servos.limit)
    q = torch.from_numpy(random["q"])
    # The MJCF file has the angles of the URDF. The reference must have the same angles: the model has angles rounded to
    # multiples of pi/2, which would change M.
    bodies = copy.deepcopy(projection.bodies)
    bodies.chain = body_chain(tip_frame(projection.arm).chain)
    mass = bodies.mass_matrix(q)
    bias = bodies.nonlinear_effects(q, torch.from_numpy(random["qd"]))
    force = torch.from_numpy(torques @ projection.inputs.T) - bias
    expected = {"mass_matrix": mass, "bias": bias, "forward_dynamics": torch.linalg.solve(mass, force)}
    simulated = _simulated(text, arm, random["q"], random["qd"], controls)
    differences = {name: relative(values, expected[name].numpy()) for name, values in simulated.items()}
    reference = "the model's rigid bodies with the URDF's unrounded angles"
    return require_parity(differences, TUNING.mujoco_tolerance, states, reference)


def _simulated(text: bytes, arm: Chain, q: np.ndarray, qd: np.ndarray, controls: np.ndarray) -> Values:
    """Return {entry point: M, bias or accelerations, computed by MuJoCo in the coordinates of the arm}.

    Accelerations are omitted for an arm with mimic joints.

    Args:
        text: content of the MJCF file.
        arm: arm with n coordinates.
        q, qd: positions and velocities of the coordinates, (states, n) [rad, m] and [rad/s, m/s].
        controls: inputs of the actuators, (states, n): torques [Nm, N] or, for position servos, commands [rad, m].
    """
    model = mujoco.MjModel.from_xml_string(text.decode())
    # Friction and limits of joint torques are switched off in MuJoCo, because the rigid bodies with which `check_mjcf`
    # compares MuJoCo have neither. (Friction in MuJoCo differs from friction in the model.) The torque limits of servos
    # are compared.
    model.jnt_actfrclimited[:] = 0
    model.dof_damping[:] = 0.0
    model.dof_frictionloss[:] = 0.0
    # `constraint` is the linear map from the coordinates to the positions of all joints, including mimic joints.
    constraint = body_constraint(arm)
    # The rows of `constraint`, one per joint, are sorted in MuJoCo's order of joints, the order of the tree of bodies.
    order = np.argsort([model.joint(name).dofadr[0] for name in constraint.names])
    jacobian, offset = constraint.jacobian[order], constraint.offset[order]
    driven = [arm.joint_names.index(model.actuator(k).name) for k in range(model.nu)]
    data = mujoco.MjData(model)
    # `full`: MuJoCo stores a sparse M, which mj_fullM expands into this array.
    full = np.zeros((model.nv, model.nv))
    values: dict[str, list[np.ndarray]] = {"mass_matrix": [], "bias": [], "forward_dynamics": []}
    for position, velocity, control in zip(q, qd, controls, strict=True):
        data.qpos[:] = jacobian @ position + offset
        data.qvel[:] = jacobian @ velocity
        data.ctrl[:] = control[driven]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        values["mass_matrix"].append(jacobian.T @ full @ jacobian)
        values["bias"].append(jacobian.T @ data.qfrc_bias)
        values["forward_dynamics"].append(jacobian.T @ data.qacc)
    # In MuJoCo, mimic joints are soft constraints, and in the model they are exact. The accelerations differ and are
    # therefore not compared.
    if model.nv > len(arm.coordinates):
        del values["forward_dynamics"]
    return {name: np.array(rows) for name, rows in values.items()}


def mjcf_text(projection: RigidBodyProjection) -> tuple[bytes, str]:
    """Return the content of the MJCF file of rigid bodies, and the names of links whose shapes are omitted.

    Shapes that are flat or cannot be read are omitted. The angles of joint origins are the URDF's, such as 1.5708, and
    not rounded to pi/2 as in the model, so that the tip has the same pose as in other tools that read the URDF. The
    actuators are one motor per nonzero column of the input matrix G (joint torques per motor torque) or, for position
    servos, one position actuator per joint.
    """
    arm = projection.arm.chain
    root = etree.Element("mujoco", model=arm.name)
    # MuJoCo's default unit of angles is degrees. With autolimits each given range is a limit.
    _add(root, "compiler", angle="radian", autolimits="true")
    _add(root, "option", gravity=arm.gravity)
    world, equality, tendons, actuators, assets = (etree.SubElement(root, tag) for tag in _SECTIONS)
    # `is_coupled`: motors whose speed depends on several joints; their inertia is the armature of a tendon, not of a
    # joint. `motors`: matrix C, (n, n), motor velocities = C qd.
    bodies, motors = projection.bodies, motors_of(projection.bodies).numpy()
    is_coupled = np.count_nonzero(motors, axis=1) > 1
    elements, tip = [world], tip_frame(projection.arm)
    for body, inertia in zip(tip.chain.bodies, bodies.inertial_parameters.numpy(), strict=True):
        name = projection.arm.robot.joint[body.name].child
        pose = {"pos": body.translation, "quat": quaternion(body.rotation)}
        element = _add(elements[body.parent + 1], "body", name=name, **pose)
        elements.append(element)
        mass, center, tensor = about_center(inertia)
        # MuJoCo's order of the moments is xx, yy, zz, xy, xz, yz.
        moments = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        _add(element, "inertial", mass=mass, pos=center, fullinertia=moments)
        joint_type = "hinge" if body.joint_type == "revolute" else "slide"
        joint = {"name": body.name, "axis": (0, 0, 1), "type": joint_type}
        leader = arm.coordinates[body.coordinate]
        if leader.name == body.name:
            _add(element, "joint", **joint, **_drive(projection, body.coordinate, is_coupled))
            continue
        # A mimic joint has no motor, friction or limits. In MuJoCo its position is a polynomial of the
        # leader's position, enforced by a soft constraint.
        _add(element, "joint", **joint)
        polynomial = body.offset, body.multiplier, 0, 0, 0
        _add(equality, "joint", joint1=body.name, joint2=leader.name, polycoef=polynomial)
    pose = {"pos": tip.pose[:3, 3], "quat": quaternion(tip.pose[:3, :3])}
    _add(elements[tip.carrier + 1], "site", name=tip.link, **pose)
    for k in np.flatnonzero(is_coupled).tolist():
        rotor = _add_tendon(tendons, f"rotor{k + 1}", arm.coordinates, motors[k])
        rotor.set("armature", _text(float(bodies.armature[k])))
    if projection.servos is None:
        _add_motors(actuators, tendons, projection)
    else:
        _add_servos(actuators, arm.coordinates, projection.servos)
    omitted = _add_shapes(assets, elements, projection.arm)
    for section in (equality, tendons, assets):
        if not len(section):
            root.remove(section)
    # The XML is indented, so that the file is readable.
    etree.indent(root)
    return bytes(etree.tostring(root, xml_declaration=True, encoding="utf-8")) + b"\n", omitted


def _drive(projection: RigidBodyProjection, k: int, is_coupled: np.ndarray) -> dict[str, object]:
    """Return the MJCF attributes of joint k from the rigid bodies of a model: armature, friction and limits.

    is_coupled: (n,), True for a motor whose speed depends on several joints. For such a motor k the armature of joint k
    is 0, because the armature is an attribute of a tendon.
    """
    friction, joint = projection.friction, projection.arm.chain.coordinates[k]
    # With position servos, the learned torque limit is an attribute of the actuator, so the joint gets no limit.
    effort = joint.effort if projection.servos is None else None
    return {
        # The armature of a coupled motor is an attribute of a tendon, see `mjcf_text`.
        "armature": 0.0 if is_coupled[k] else float(projection.bodies.armature[k]),
        "damping": friction.viscous[k],
        "frictionloss": friction.coulomb[k],
        "solimpfriction": " ".join(f"{number:g}" for number in TUNING.friction_impedance),
        "range": joint.limits,
        "actuatorfrcrange": None if effort is None else (-effort, effort),
    }


def _add_motors(actuators: etree._Element, tendons: etree._Element, projection: RigidBodyProjection) -> None:
    """Add a MuJoCo motor for each nonzero column of the input matrix G: at a joint, or at a tendon for several joints.

    actuators, tendons: elements of the MJCF to which motors and tendons are added.
    """
    joints = projection.arm.chain.coordinates
    for k, column in enumerate(projection.inputs.T):
        name, driven = joints[k].name, np.flatnonzero(column)
        if driven.size == 1:
            (index,) = driven
            _add(actuators, "motor", name=name, joint=joints[index].name, gear=column[index])
        elif driven.size > 1:
            _add_tendon(tendons, f"motor{k + 1}", joints, column)
            _add(actuators, "motor", name=name, tendon=f"motor{k + 1}")


def _add_servos(actuators: etree._Element, joints: Sequence[Coordinate], servos: Servos) -> None:
    """Add a MuJoCo position actuator for each joint. The delay of the servos cannot be represented in the file."""
    for k, joint in enumerate(joints):
        limit = servos.limit[k]
        # MuJoCo refuses an infinite force range; without the attribute the force is unlimited.
        force = (-limit, limit) if np.isfinite(limit) else None
        gains = {"kp": servos.kp[k], "kv": servos.kd[k]}
        _add(actuators, "position", name=joint.name, joint=joint.name, **gains, forcerange=force)


def _add_tendon(
    tendons: etree._Element, name: str, joints: Sequence[Coordinate], coefficients: np.ndarray
) -> etree._Element:
    """Add a tendon to an MJCF; return its element.

    The length of the tendon is the sum of the coefficients (n,) times the joint positions.
    """
    tendon = _add(tendons, "fixed", name=name)
    for joint, coefficient in zip(joints, coefficients, strict=True):
        if coefficient:
            _add(tendon, "joint", joint=joint.name, coef=coefficient)
    return tendon


def _add_shapes(assets: etree._Element, elements: Sequence[etree._Element], arm: Arm) -> str:
    """Add the visual and collision shapes of all links to an MJCF; return the names of links with omitted shapes.

    The names are separated by commas. A shape is omitted if it is flat or cannot be read.

    Args:
        assets: element of the MJCF to which meshes are added.
        elements: elements of the world and of the bodies, in the order of the arm.
        arm: arm whose URDF has the shapes.
    """
    names = [link.name for link in arm.robot.links]
    omitted: dict[str, None] = {}
    poses = link_poses(arm)
    for kind, attributes in _CONTACTS.items():
        shapes = link_shapes(arm.robot.path, kind, names, TUNING.faces)
        omitted |= dict.fromkeys(shapes.unread)
        for shape in shapes.shapes:
            if min(shape.size) == 0 or (shape.mesh is not None and _is_flat(shape.mesh[0])):
                omitted[shape.link] = None
                continue
            carrier, pose = poses[shape.link]
            pose = pose @ shape.pose
            form = _geom(shape, assets) | {"pos": pose[:3, 3], "quat": quaternion(pose[:3, :3])}
            # Shapes have no mass, since the <inertial> of the body has the whole mass.
            _add(elements[carrier + 1], "geom", **form, **attributes, mass=0)
    return ", ".join(omitted)


def _geom(shape: LinkShape, assets: etree._Element) -> dict[str, object]:
    """Return the MJCF attributes of the geom of a shape, such as type and size; a mesh is also added to `assets`."""
    if shape.mesh is None:
        sizes = {"box": [x / 2 for x in shape.size], "cylinder": [shape.size[0], shape.size[-1] / 2]}
        return {"type": shape.kind, "size": sizes.get(shape.kind, shape.size)}
    vertices, faces = shape.mesh
    # Vertices of meshes have six digits only, since a mesh has thousands of numbers.
    rows, name = " ".join(f"{x:.6g}" for x in vertices.ravel().tolist()), f"mesh{len(assets) + 1}"
    _add(assets, "mesh", name=name, vertex=rows, face=faces, inertia="shell")
    return {"type": "mesh", "mesh": name}


def _is_flat(vertices: np.ndarray) -> bool:
    """Return True if the V vertices (V, 3) of a mesh lie in a plane, so that the convex hull has no volume."""
    # A flat mesh may lie in any plane, so its thickness is the smallest singular value.
    extents = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    return len(extents) < 3 or bool(extents[2] <= TUNING.flat * extents[0])


def _add(parent: etree._Element, tag: str, **attributes: object) -> etree._Element:
    """Add an XML element to `parent` and return it; attributes that are None are omitted."""
    texts = {name: _text(value) for name, value in attributes.items() if value is not None}
    return etree.SubElement(parent, tag, texts)


def _text(value: object) -> str:
    """Return the value of an XML attribute: a text unchanged, numbers with all digits and separated by blanks."""
    if isinstance(value, str):
        return value
    return " ".join(f"{float(number):.17g}" for number in np.ravel(value))  # type: ignore[call-overload]
