"""--to mjcf: a file that MuJoCo loads, held against the model in MuJoCo itself."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import torch

from spelgen.exporting.describe import servos_of
from spelgen.exporting.exported import Exported
from spelgen.exporting.mjcf_file import mjcf_text
from spelgen.exporting.parity import STATES, Parity, random_inputs, relative
from spelgen.exporting.readme import UNITS, readme
from spelgen.exporting.rigid_body_projection import RigidBodyProjection, rigid_body_projection
from spelgen.exporting.trained import Trained
from spelgen.exporting.urdf_export import projection_summary

TOLERANCE = 1e-9


def export_mjcf(trained: Trained) -> Exported:
    """The MJCF of a trained model: its own bodies where it has such, else the nearest ones.

    Raises RunError where MuJoCo's M, bias and forward dynamics are not those bodies'.
    """
    projection = rigid_body_projection(trained.model, trained.arm)
    exact: Any = copy.deepcopy(trained.model).double().cpu().requires_grad_(False)
    gains = exact.input_matrix(torch.zeros(exact.n, dtype=torch.float64)).numpy()
    servos = servos_of(exact)
    text = mjcf_text(projection, gains, trained.tip_in_body, servos)
    summary = projection_summary(projection)
    if servos is not None:
        exact.servo.dead_zone.zero_()  # MuJoCo's actuators have none
    parity = check_mjcf(text, projection, gains, exact.servo if servos else None)
    checked = f"Checked when exported, by MuJoCo {mujoco.__version__}, friction apart: {parity.summary}"
    use = (
        "mujoco.MjModel.from_xml_path(FILE.xml): bodies by the names of the links that their joints move, armature, "
        "viscous friction as damping and Coulomb friction as frictionloss, a motor for each input."
    )
    if servos is not None:
        use = use.replace("a motor for each input", "a position actuator for each servo")
        use += f" Give ctrl the command of {servos.delay:.4g} s before."
        if servos.dead_zone.any():
            use += " The servos' dead zones are left out: MuJoCo's position actuators have none."
    about = f"{UNITS}; a body's frame has its joint's axis as z; torque offsets of the sensors are left out."
    name = trained.arm.arm.name
    last = f"{'; '.join((checked, *summary))}."
    text_of_readme = readme(f"{name} for MuJoCo", use, trained.joint_names, about, last)
    return Exported("mjcf", name, {".xml": text, ".README.md": text_of_readme}, (*summary, checked))


def check_mjcf(
    text: bytes, projection: RigidBodyProjection, gains: np.ndarray, servo: Any = None, states: int = STATES
) -> Parity:
    """M, bias and forward dynamics without friction, by MuJoCo and by the bodies' own model. Raises RunError.

    servo: of a model with position servos, whose actuators are given commands.
    """
    model, arm = projection.bodies, projection.arm.arm
    simulated = mujoco.MjModel.from_xml_string(text.decode())
    simulated.dof_damping[:], simulated.dof_frictionloss[:] = 0.0, 0.0
    data = mujoco.MjData(simulated)
    joints = [simulated.joint(body.name) for body in arm.bodies]
    places = [int(simulated.jnt_dofadr[joint.id]) for joint in joints]
    jacobian, offset = np.zeros((simulated.nv, model.n)), np.zeros(simulated.nv)
    for place, body in zip(places, arm.bodies, strict=True):
        jacobian[place, body.coordinate], offset[place] = float(body.multiplier), body.offset
    inputs = random_inputs(arm.coordinates, states)
    actuators = [simulated.actuator(c.name).id for c in arm.coordinates if _driven(simulated, c.name)]
    driven = [k for k, c in enumerate(arm.coordinates) if _driven(simulated, c.name)]
    masses, biases, accelerations = [], [], []
    controls = inputs["tau"] if servo is None else inputs["u"]
    for q, qd, control in zip(inputs["q"], inputs["qd"], controls, strict=True):
        data.qpos[:], data.qvel[:] = jacobian @ q + offset, jacobian @ qd
        data.ctrl[actuators] = control[driven]
        mujoco.mj_forward(simulated, data)
        full = np.zeros((simulated.nv, simulated.nv))
        mujoco.mj_fullM(simulated, data, full)
        masses.append(jacobian.T @ full @ jacobian)
        biases.append(jacobian.T @ data.qfrc_bias)
        accelerations.append(data.qacc[places[: model.n]].copy())
    q, qd, tau = (torch.from_numpy(inputs[key]) for key in ("q", "qd", "tau"))
    differences = {
        "mass_matrix": relative(np.array(masses), model.mass_matrix(q).numpy()),
        "bias": relative(np.array(biases), model.nonlinear_effects(q, qd).numpy()),
    }
    if simulated.nv == model.n:  # with followers MuJoCo's constraint is soft
        tau = tau if servo is None else servo(torch.from_numpy(inputs["u"]), q, qd)
        force = tau @ torch.from_numpy(gains.T) - model.nonlinear_effects(q, qd)
        free = torch.linalg.solve(model.mass_matrix(q), force.unsqueeze(-1))
        differences["forward_dynamics"] = relative(np.array(accelerations), free.squeeze(-1).numpy())
    return Parity(differences, TOLERANCE, states).require()


def _driven(simulated: mujoco.MjModel, name: str) -> bool:
    return mujoco.mj_name2id(simulated, mujoco.mjtObj.mjOBJ_ACTUATOR, name) >= 0
