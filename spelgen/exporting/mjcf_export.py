"""--to mjcf: a file that MuJoCo loads, held against the model in MuJoCo itself."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import torch

from spelgen.arm.arm import Arm
from spelgen.exporting.describe import array, servos_of
from spelgen.exporting.description import Servos
from spelgen.exporting.exported import UNITS, Exported, readme
from spelgen.exporting.mjcf_file import mjcf_text
from spelgen.exporting.parity import Parity, Values, random_inputs, relative
from spelgen.exporting.rigid_body_projection import RigidBodyProjection, rigid_body_projection
from spelgen.exporting.tip_frame import tip_frame
from spelgen.exporting.trained import Trained
from spelgen.settings.tuning.exporting import TUNING


def export_mjcf(trained: Trained) -> Exported:
    """Return the MJCF of a trained model: its own bodies where it has such, else the nearest ones.

    Raises RunError where MuJoCo's M, bias and forward dynamics are not those bodies'.
    """
    projection = rigid_body_projection(trained.model, trained.arm)
    exact = copy.deepcopy(trained.model).double().cpu()
    inputs = array(exact.input_matrix(torch.zeros(exact.n, dtype=torch.float64)))
    servos = servos_of(exact)
    text = mjcf_text(projection, inputs, tip_frame(trained.arm), servos)
    parity = check_mjcf(text, projection, inputs, servos)
    checked = f"Checked when exported, by MuJoCo {mujoco.__version__}, friction apart: {parity.summary}"
    actuators = "a motor for each input."
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


def check_mjcf(
    text: bytes,
    projection: RigidBodyProjection,
    inputs: np.ndarray,
    servos: Servos | None = None,
    states: int = TUNING.states,
) -> Parity:
    """Compare M, bias and forward dynamics without friction, of MuJoCo and of the bodies' own model. Raises RunError.

    Under position servos the actuators are given commands.
    """
    arm = projection.arm.arm
    model = mujoco.MjModel.from_xml_string(text.decode())
    # MuJoCo's friction is not the model's: it is left out of the comparison
    model.dof_damping[:] = 0.0
    model.dof_frictionloss[:] = 0.0
    random = random_inputs(arm.coordinates, states)
    q = torch.from_numpy(random["q"])
    qd = torch.from_numpy(random["qd"])
    controls = torques = random["tau"]
    if servos is not None:
        controls = random["u"]
        torques = _servo_torques(servos, random)
    masses, biases, accelerations = _simulated(model, arm, random["q"], random["qd"], controls)
    mass = projection.bodies.mass_matrix(q)
    bias = projection.bodies.nonlinear_effects(q, qd)
    differences = {
        "mass_matrix": relative(masses, mass.numpy()),
        "bias": relative(biases, bias.numpy()),
    }
    if model.nv == len(arm.coordinates):  # MuJoCo's constraint for followers is soft
        force = torch.from_numpy(torques @ inputs.T) - bias
        expected = torch.linalg.solve(mass, force)
        differences["forward_dynamics"] = relative(accelerations, expected.numpy())
    return Parity(differences, TUNING.mujoco_tolerance, states).require()


def _servo_torques(servos: Servos, inputs: Values) -> np.ndarray:
    """Return the torques of MuJoCo's position actuators, which have no dead zone, (states, n)."""
    torques = servos.kp * (inputs["u"] - inputs["q"]) - servos.kd * inputs["qd"]
    clipped: np.ndarray = np.clip(torques, -servos.limit, servos.limit)
    return clipped


def _simulated(
    model: mujoco.MjModel, arm: Arm, q: np.ndarray, qd: np.ndarray, controls: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return M, bias and accelerations of states, (states, ...), by the coordinates of the arm."""
    dofs = [int(model.jnt_dofadr[model.joint(body.name).id]) for body in arm.bodies]
    # followers move with their leaders
    jacobian = np.zeros((model.nv, len(arm.coordinates)))
    offset = np.zeros(model.nv)
    for dof, body in zip(dofs, arm.bodies, strict=True):
        jacobian[dof, body.coordinate] = float(body.multiplier)
        offset[dof] = body.offset
    columns = {joint.name: k for k, joint in enumerate(arm.coordinates)}
    driven = [columns[model.actuator(k).name] for k in range(model.nu)]
    data = mujoco.MjData(model)
    full = np.zeros((model.nv, model.nv))
    masses: list[np.ndarray] = []
    biases: list[np.ndarray] = []
    accelerations: list[np.ndarray] = []
    for position, velocity, control in zip(q, qd, controls, strict=True):
        data.qpos[:] = jacobian @ position + offset
        data.qvel[:] = jacobian @ velocity
        data.ctrl[:] = control[driven]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        masses.append(jacobian.T @ full @ jacobian)
        biases.append(jacobian.T @ data.qfrc_bias)
        accelerations.append(data.qacc[dofs].copy())
    return np.array(masses), np.array(biases), np.array(accelerations)
