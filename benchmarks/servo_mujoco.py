"""An arm under position servos in MuJoCo: a simulated robot for other benchmarks, and a rival of a fitted model.

    python benchmarks/servo_mujoco.py RUN --train LOGS... --test LOGS...

Such an arm is usually simulated with MuJoCo's position actuators. The rival has the bodies of the URDF and these
actuators. Its kp, kv, armature, frictionloss and command offset of each joint, and one delay, are fitted to windows of
the training logs by `mujoco.minimize`, the least squares of `mujoco.sysid`. The initial values are the parameters of
the run's model. Dry friction has the stiffest constraint that MuJoCo allows, as in the files of `spelgen export --to
mjcf`. The rival, the run's model and its other baselines then predict positions of the test logs from the commands.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from mujoco import minimize, rollout

import spelgen
from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm
from spelgen.baselines.registry import command_followers
from spelgen.dynamics.body_regressor import about_center, quaternion
from spelgen.dynamics.protocol import motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.evaluation.replay import replays
from spelgen.exporting.tuning import TUNING as EXPORT_TUNING
from spelgen.fitting.servo.windows import ServoWindows, servo_windows
from spelgen.logs.trajectory import LogRows, delayed_commands, steps_between

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

STEP = 5e-4  # [s] integration step of the simulated robot
# solref of stiff constraints of the simulated robot: time constant [s] and damping ratio (no rebound)
HARD = [2e-3, 1.0]
# joint that models backlash: armature relative to its drive's armature [1], damping relative to kp [s]
SHARE, DAMPING = 0.02, 2e-4
# [s] Largest integration step of fitted actuators. MuJoCo limits the stiffness of frictionloss: the time constant of
# this constraint is at least twice the integration step, here 10 ms.
FIT_STEP = 5e-3
# number of windows and of solver steps of the fit of actuators, which takes half a minute
WINDOWS, ITERATIONS = 60, 8
DIFFERENCE = 1e-4  # finite-difference step of the unknowns of the fit
# bounds of the fit: change of log(kp), log(kv), log(armature), log(frictionloss) [1]; offset [rad, m]; delay [s]
LOG_RANGE, OFFSET_RANGE, MAX_DELAY = 4.0, 0.3, 0.4


def arm_with_servos(
    urdf: Path,
    joints: list[str],
    kp: np.ndarray,
    ratios: dict[str, float],
    limit: np.ndarray,
    backlash: float,
) -> mujoco.MjModel:
    """Return MuJoCo's model of the URDF's arm, without visual and collision shapes, with position servos.

    Args:
        urdf: file of the arm.
        joints: names of the n driven joints.
        kp: (n,) stiffness of the servos [Nm/rad].
        ratios: "kd" [s], "armature" [s^2] and "dry" friction [rad], each relative to kp.
        limit: (n,) largest torque [Nm]; infinite: unlimited.
        backlash: half of the play of each joint's gears [rad]; 0: none.
    """
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
    """Simulate an arm with servos from rest at the first command; return the positions of its links, (T, n) [rad].

    Args:
        model: result of `arm_with_servos`; its servos control motor positions, before the backlash of the gears.
        joints: names of the n driven joints.
        u: (T, n) commands [rad].
        dt: time between commands and between positions [s].
        delay: delay of the commands [s].
    """
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


@dataclass(frozen=True, eq=False)
class PositionActuators:
    """Predictor of positions from commands: MuJoCo's position actuators on an arm with n joints and n bodies.

    The actuators get the command of ``delay`` [s] ago plus ``offset`` (n,) [rad, m].

    untrained: unfitted spelgen model, for the inertias of the URDF and the torque limits. drives: (4, n), the rows are
    kp [Nm/rad, N/m], kv [Nm s/rad, N s/m], armature [kg m^2, kg] and frictionloss [Nm, N].
    """

    arm: Chain
    untrained: ArmModel
    drives: np.ndarray
    offset: np.ndarray
    delay: float

    def positions(self, segments: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return the predicted positions (T, n) [rad, m] of each segment, without its first row.

        Args:
            segments: pairs of a log and the rows of it to predict; the log has the commands.
            q: (segments, n) initial positions [rad, m].
            qd: (segments, n) initial velocities [rad/s, m/s].
        """
        model = self.model()
        positions: list[np.ndarray] = []
        for k, (log, rows) in enumerate(segments):
            steps = steps_between(log, FIT_STEP)
            model.opt.timestep = float(np.diff(log.t[rows]).mean()) / steps
            commands = delayed_commands(log, rows, self.delay, steps) + self.offset
            positions += [*_positions(model, q[[k]], qd[[k]], commands[None])]
        return positions

    def model(self) -> mujoco.MjModel:
        """Return the arm with its actuators as MuJoCo's model; joints and actuators in the order of q."""
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        spec.option.gravity = np.array(self.arm.gravity, dtype=float)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        parents = [spec.worldbody]
        inertias = self.untrained.inertial_parameters.numpy()
        # MuJoCo's value for an unlimited torque is zero
        limits = np.nan_to_num(self.untrained.servo.limit.numpy(), posinf=0.0)
        for k, (body, coordinate) in enumerate(zip(self.arm.bodies, self.arm.coordinates, strict=True)):
            kp, kv, armature, frictionloss = self.drives[:, k]
            mass, center, tensor = about_center(inertias[k])
            element = parents[body.parent + 1].add_body(
                pos=np.array(body.translation, dtype=float),
                quat=quaternion(body.rotation),
                explicitinertial=True,
                mass=mass,
                ipos=center,
                # MuJoCo's order: xx, yy, zz, xy, xz, yz
                fullinertia=tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
            )
            parents.append(element)
            kind = (
                mujoco.mjtJoint.mjJNT_HINGE if body.joint_type == "revolute" else mujoco.mjtJoint.mjJNT_SLIDE
            )
            element.add_joint(
                name=body.name,
                type=kind,
                axis=(0, 0, 1),
                range=coordinate.limits or (0, 0),
                armature=armature,
                frictionloss=frictionloss,
                # solref, solimp and joint inertia determine the stiffness of dry friction, a constraint in MuJoCo
                solref_friction=(2 * FIT_STEP, 1),
                solimp_friction=EXPORT_TUNING.friction_impedance,
            )
            actuator = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=body.name)
            actuator.gainprm[0] = kp
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            actuator.biasprm[1:3] = -kp, -kv
            actuator.forcerange = -limits[k], limits[k]
        return spec.compile()


def _positions(model: mujoco.MjModel, q: np.ndarray, qd: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """Return the positions (W, K, n) of W windows after each of K intervals of S integration steps.

    Args:
        model: with position actuators.
        q, qd: (W, n) initial states.
        commands: (W, K, S, n) command of each step.
    """
    count, _, steps, n = commands.shape
    state = np.hstack([np.zeros((count, 1)), q, qd])  # MuJoCo's state: time, q, qd
    states, _ = rollout.rollout(model, mujoco.MjData(model), state, commands.reshape(count, -1, n))
    return np.asarray(states[:, steps - 1 :: steps, 1 : 1 + n])


def fit_position_actuators(arm: Arm, windows: ServoWindows, trained: ArmModel) -> PositionActuators:
    """Fit position actuators to windows of logs, from the drives of a ``trained`` model as initial values.

    Exits with a message if joints are coupled.
    """
    n = len(arm.chain.coordinates)
    if len(arm.chain.bodies) > n or (motors_of(trained).numpy() != np.eye(n)).any():
        sys.exit("got coupled joints, expected a motor for each joint and a joint for each body")
    servo, friction = trained.servo.prepare(), trained.friction.prepare()
    # kv is kd of the servo plus viscous friction of the joint. Only their sum affects the motion unless the actuator is
    # at its torque limit, which applies to kd but not to viscous friction.
    rows = servo.kp, servo.kd + friction.viscous, trained.armature, friction.coulomb
    start = np.stack([row.detach().numpy() for row in rows])
    is_known = trained.servo.trained.numpy() == 0
    untrained = spelgen.build(arm, "closed-form").requires_grad_(False)
    initial = PositionActuators(arm.chain, untrained, start, np.zeros(n), float(trained.servo.delay))
    steps = max(steps_between(log, FIT_STEP) for log, _ in windows.rows)
    windows = replace(windows, steps=steps)
    q, qd = windows.q.numpy(), windows.qd.numpy()

    def actuators(x: np.ndarray) -> PositionActuators:
        """Return the actuators for unknowns x, (5 n + 1,).

        x: logarithms of kp, kv, armature and frictionloss of n joints, n command offsets [rad, m], and the delay [s].
        """
        drives, offset = np.split(x[:-1].reshape(5, n), [4])
        drives = np.exp(drives)
        drives[0, is_known] = start[0, is_known]
        return replace(initial, drives=drives, offset=offset[0], delay=float(x[-1]))

    def errors(x: np.ndarray) -> np.ndarray:
        """Return predicted minus measured positions of S samples, (S n,) [rad, m], for unknowns x (see `actuators`).

        The first samples of each window, its burn-in, are omitted.
        """
        candidate = actuators(x)
        model = candidate.model()
        model.opt.timestep = 1 / windows.rate / steps
        commands = windows.commands(candidate.delay).numpy() + candidate.offset
        error = _positions(model, q[:, 0], qd[:, 0], commands) - q[:, 1:]
        return error[:, windows.burn_in :].ravel()

    def residuals(x: np.ndarray) -> np.ndarray:
        """Return the position errors of S samples, (S n, C), for C vectors of unknowns, the columns of x."""
        return np.stack([errors(column) for column in x.T], axis=1)

    def jacobian(x: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """Return the derivative of the position errors of S samples with respect to x, (S n, 5 n + 1).

        It is computed by finite differences. Each of the five parameters per joint, such as log(kp), is changed at all
        joints at once: the effect of a joint's parameter on other joints is small and neglected. The last column is for
        the delay. residuals: (S n, 1), errors at x. x: (5 n + 1, 1) unknowns (see `actuators`).
        """
        derivatives = np.zeros((len(residuals) // n, n, len(x)))
        for columns in (*np.arange(5 * n).reshape(5, n), 5 * n):
            changed = x.ravel().copy()
            changed[columns] += DIFFERENCE
            change = (errors(changed) - residuals.ravel()) / DIFFERENCE
            derivatives[:, np.arange(n), columns] = change.reshape(-1, n)
        return derivatives.reshape(len(residuals), -1)

    first = np.append(np.log(start), np.zeros(n))
    bounds = np.repeat([LOG_RANGE, OFFSET_RANGE], [4 * n, n])
    x, _ = minimize.least_squares(
        np.append(first, initial.delay),
        residuals,
        (np.append(first - bounds, 0.0), np.append(first + bounds, MAX_DELAY)),
        jacobian,
        mu_factor=10.0,
        max_iter=ITERATIONS,
        verbose=minimize.Verbosity.SILENT,
    )
    return actuators(x.ravel())


def main() -> None:
    """Fit the actuators to the training logs, and print the errors of all predictors on the test logs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--train", type=Path, nargs="+", required=True)
    parser.add_argument("--test", type=Path, nargs="+", required=True)
    asked = parser.parse_args()
    fit = spelgen.load_run(asked.run)
    if fit.record.servo is None or fit.urdf is None:
        parser.error(f"{asked.run} has to be the finished run of an arm under position servos, with its URDF")
    options = fit.model.spec.options
    arm = spelgen.load_arm(fit.urdf, options.joints, options.tip, options.angle_tolerance)
    logs = spelgen.read_logs(asked.train, arm, fit.record.mapping)
    windows = servo_windows(logs, fit.preprocessing, WINDOWS)
    start = time.monotonic()
    actuators = fit_position_actuators(arm, windows, fit.model)
    print(f"fitted in {time.monotonic() - start:.0f} s; delay {1000 * actuators.delay:.1f} ms")
    for name, row in zip(("kp", "kv", "armature", "frictionloss"), actuators.drives, strict=True):
        print(f"{name:14}", *(f"{value:10.4g}" for value in row))
    followers = {"MuJoCo actuators": actuators} | command_followers(fit.record.servo["linear"], [])
    test = spelgen.read_logs(asked.test, arm, fit.record.mapping)
    for replay in replays(fit.model, test, followers, [])[0]:
        print(f"{replay.name}: RMS of positions over all joints [mrad, mm]")
        for name, errors in replay.errors.items():
            print(f"  {name:18}{1000 * errors.mean:8.3g}")


if __name__ == "__main__":
    main()
