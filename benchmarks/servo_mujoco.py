"""An arm under position servos as MuJoCo simulates it: dry friction by constraints, gears with backlash as joints."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np

STEP = 5e-4  # s
HARD = [2e-3, 1.0]  # of constraints: a time constant [s], and no rebound
SHARE, DAMPING = 0.02, 2e-4  # of a joint of backlash: of the armature, and what it loses, by kp [s]


def arm_with_servos(
    urdf: Path,
    joints: list[str],
    kp: np.ndarray,
    ratios: dict[str, float],
    limit: np.ndarray,
    backlash: float,
) -> mujoco.MjModel:
    """Of the URDF's bodies without shapes; ratios: kd, armature and dry friction by kp; backlash: half of it [rad]."""
    text = re.sub(r"<(visual|collision)>.*?</\1>", "", urdf.read_text(), flags=re.DOTALL)
    spec = mujoco.MjSpec.from_string(text)
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for name, gain, most in zip(joints, kp, limit, strict=True):
        joint = spec.joint(name)
        joint.armature, joint.frictionloss = gain * ratios["armature"], gain * ratios["dry"]
        joint.solref_friction, joint.solimp_friction = HARD, [0.99, 0.9999, 1e-4, 0.5, 2]
        if backlash:
            gears = joint.parent.add_joint(
                name=f"{name} gears",
                axis=joint.axis,
                pos=joint.pos,
                limited=True,
                range=[-backlash, backlash],
            )
            gears.armature, gears.solref_limit = SHARE * joint.armature, HARD
            gears.damping[:] = DAMPING * gain
        drive = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        drive.gainprm[0], drive.biastype = gain, mujoco.mjtBias.mjBIAS_AFFINE
        drive.biasprm[1], drive.biasprm[2] = -gain, -gain * ratios["kd"]
        if np.isfinite(most):
            drive.forcelimited, drive.forcerange = True, [-most, most]
    return spec.compile()


def positions(model: mujoco.MjModel, joints: list[str], u: np.ndarray, dt: float, delay: float) -> np.ndarray:
    """(T, n) under commands (T, n) from rest at the first ones. Encoders are behind the gears, and servos know them."""
    data = mujoco.MjData(model)
    drive = [model.joint(x).qposadr[0] for x in joints]
    names = {model.joint(k).name for k in range(model.njnt)}
    gears = [model.joint(f"{x} gears").qposadr[0] for x in joints if f"{x} gears" in names]
    data.qpos[drive] = u[0]
    late, per, found = round(delay / STEP), round(dt / STEP), []
    for k in range(per * len(u)):
        behind = data.qpos[gears] if gears else 0.0
        if k % per == 0:
            found.append(data.qpos[drive] + behind)
        data.ctrl[:] = u[max(0, k - late) // per] - behind
        mujoco.mj_step(model, data)
    return np.array(found)
