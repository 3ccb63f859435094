"""--to mjcf: a file that MuJoCo loads, held against the model in MuJoCo itself."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from spelgen.arm.arm import Arm
from spelgen.exporting.describe import Trained
from spelgen.exporting.exported import UNITS, Exported, readme
from spelgen.exporting.mjcf_file import mjcf_text
from spelgen.exporting.parity import Parity, Values, random_inputs, relative, require_parity
from spelgen.exporting.rigid_body_projection import RigidBodyProjection, rigid_body_projection
from spelgen.exporting.tuning import TUNING


def export_mjcf(trained: Trained) -> Exported:
    """Return the MJCF of a trained model: its own bodies where it has such, else the nearest ones.

    Raises RunError where MuJoCo's M, bias and forward dynamics are not those bodies'.
    """
    projection = rigid_body_projection(trained.model, trained.arm)
    text = mjcf_text(projection)
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
    about = f"{UNITS}; a body's frame has its joint's axis as z; torque offsets of the sensors are left out."
    result = f"{'; '.join((checked, *projection.summary))}."
    text_of_readme = readme(f"{trained.robot} for MuJoCo", use, trained.joint_names, about, result)
    files = {".xml": text, ".xml.README.md": text_of_readme}
    return Exported("mjcf", trained.robot, files, (*projection.summary, checked))


def check_mjcf(text: bytes, projection: RigidBodyProjection, states: int = TUNING.states) -> Parity:
    """Compare M, bias and forward dynamics without friction, of MuJoCo and of the bodies' own model. Raises RunError.

    Under position servos the actuators are given commands.
    """
    arm, servos = projection.arm.arm, projection.servos
    random = random_inputs(arm.coordinates, states)
    controls = torques = random["tau"]
    if servos is not None:
        # MuJoCo's position actuators have no dead zone
        controls = random["u"]
        torques = servos.kp * (controls - random["q"]) - servos.kd * random["qd"]
        torques = np.clip(torques, -servos.limit, servos.limit)
    q = torch.from_numpy(random["q"])
    mass = projection.bodies.mass_matrix(q)
    bias = projection.bodies.nonlinear_effects(q, torch.from_numpy(random["qd"]))
    force = torch.from_numpy(torques @ projection.inputs.T) - bias
    expected = {"mass_matrix": mass, "bias": bias, "forward_dynamics": torch.linalg.solve(mass, force)}
    differences: dict[str, float] = {}
    for name, values in _simulated(text, arm, random["q"], random["qd"], controls).items():
        differences[name] = relative(values, expected[name].numpy())
    return require_parity(differences, TUNING.mujoco_tolerance, states)


def _simulated(text: bytes, arm: Arm, q: np.ndarray, qd: np.ndarray, controls: np.ndarray) -> Values:
    """Return M, bias and, where no joint follows another, accelerations of states, by the coordinates of the arm."""
    model = mujoco.MjModel.from_xml_string(text.decode())
    # MuJoCo's friction is not the model's: it is left out of the comparison
    model.dof_damping[:] = 0.0
    model.dof_frictionloss[:] = 0.0
    # followers move with their leaders
    jacobian = np.zeros((model.nv, len(arm.coordinates)))
    offset = np.zeros(model.nv)
    for body in arm.bodies:
        (dof,) = model.joint(body.name).dofadr
        jacobian[dof, body.coordinate] = float(body.multiplier)
        offset[dof] = body.offset
    driven = [arm.joint_names.index(model.actuator(k).name) for k in range(model.nu)]
    data = mujoco.MjData(model)
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
    # MuJoCo's constraint for followers is soft
    if model.nv > len(arm.coordinates):
        del values["forward_dynamics"]
    return {name: np.array(rows) for name, rows in values.items()}
