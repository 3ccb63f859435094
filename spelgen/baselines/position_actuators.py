"""Fit MuJoCo's position actuators, with which most people simulate such an arm.

Armature and frictionloss of each joint are fitted too. Fitted to the logs that a model of position servos was trained
on, they are what it has to beat.

The bodies are the URDF's, and friction is as hard as MuJoCo takes it, as `spelgen export --to mjcf` writes both.
Windows are rolled out by `mujoco.rollout` and fitted by `mujoco.minimize`, which is what `mujoco.sysid` fits with, and
needs none of that package's extra.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from mujoco import minimize, rollout

from spelgen.arm.arm import Arm
from spelgen.baselines.tuning import ACTUATORS as TUNING
from spelgen.dynamics.protocol import motors_of
from spelgen.dynamics.rigid_bodies import about_center, quaternion
from spelgen.exporting.tuning import TUNING as EXPORT_TUNING
from spelgen.fitting.servo.windows import ServoWindows
from spelgen.logs.commands import LogRows, delayed_commands, steps_between
from spelgen.pipeline.build import build
from spelgen.pipeline.loaded_arm import LoadedArm

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

FARTHEST, OFFSET, LATEST = 4.0, 0.3, 0.4  # bounds: of logarithms from their start; rad, m; s


@dataclass(frozen=True, eq=False)
class PositionActuators:
    """Predict an arm of n joints in MuJoCo, each of which moves one of the URDF's bodies.

    untrained: a model of these bodies. drives: kp, kv, armature and frictionloss, (4, n). The actuators get the command
    of ``delay`` [s] ago, and ``offset`` (n,).
    """

    arm: Arm
    untrained: EmittedModel
    drives: np.ndarray
    offset: np.ndarray
    delay: float
    about = (
        "position actuators on the URDF's bodies; kp, kv, armature, frictionloss, offsets and delay fitted to windows "
        "of the training logs by mujoco.minimize, the least squares of mujoco.sysid"
    )

    @classmethod
    def of_arm(cls, arm: LoadedArm, drives: object, offset: object, delay: float) -> PositionActuators:
        """Return such actuators of an arm. Raises TypeError or ValueError for numbers of other joints."""
        n = len(arm.arm.coordinates)
        untrained = build(arm, "closed-form").requires_grad_(False)
        rows = np.reshape(np.array(drives, dtype=float), (4, n))
        return cls(arm.arm, untrained, rows, np.reshape(np.array(offset, dtype=float), n), float(delay))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form: what was fitted."""
        return {"drives": self.drives.tolist(), "offset": self.offset.tolist(), "delay": self.delay}

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return positions (K, n) after each interval of each part of a log, from q and qd (parts, n)."""
        model = self.model()
        positions: list[np.ndarray] = []
        for k, (log, rows) in enumerate(parts):
            steps = steps_between(log, TUNING.step)
            model.opt.timestep = float(np.diff(log.t[rows]).mean()) / steps
            commands = delayed_commands(log, rows, self.delay, steps) + self.offset
            positions += [*_rollout(model, q[[k]], qd[[k]], commands[None])]
        return positions

    def model(self) -> mujoco.MjModel:
        """Return the arm with its actuators as MuJoCo's model; joints and actuators in the order of q."""
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        spec.option.gravity = np.array(self.arm.gravity, dtype=float)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        parents = [spec.worldbody]
        inertias = self.untrained.inertial_parameters.numpy()
        # MuJoCo has zero where nothing limits
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
                # MuJoCo has xx, yy, zz, xy, xz, yz
                fullinertia=tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
            )
            parents.append(element)
            kind = mujoco.mjtJoint.mjJNT_HINGE if body.kind == "revolute" else mujoco.mjtJoint.mjJNT_SLIDE
            element.add_joint(
                name=body.name,
                type=kind,
                axis=(0, 0, 1),
                range=coordinate.limits or (0, 0),
                armature=armature,
                frictionloss=frictionloss,
                # how soft frictionloss is goes by the inertia and by these
                solref_friction=(2 * TUNING.step, 1),
                solimp_friction=EXPORT_TUNING.friction_impedance,
            )
            actuator = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=body.name)
            actuator.gainprm[0] = kp
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            actuator.biasprm[1:3] = -kp, -kv
            actuator.forcerange = -limits[k], limits[k]
        return spec.compile()


def _rollout(model: mujoco.MjModel, q: np.ndarray, qd: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """Return positions (W, K, n) after each interval, from q and qd (W, n), under commands (W, K, S, n)."""
    count, _, steps, n = commands.shape
    state = np.hstack([np.zeros((count, 1)), q, qd])  # MuJoCo's has the time first
    states, _ = rollout.rollout(model, mujoco.MjData(model), state, commands.reshape(count, -1, n))
    return np.asarray(states[:, steps - 1 :: steps, 1 : 1 + n])


def fit_position_actuators(
    arm: LoadedArm, windows: ServoWindows, trained: EmittedModel
) -> PositionActuators | None:
    """Fit to windows, starting with the drives of a ``trained`` model of the arm; None where joints are coupled."""
    n = len(arm.arm.coordinates)
    if len(arm.arm.bodies) > n or (motors_of(trained).numpy() != np.eye(n)).any():
        return None
    servo, friction = trained.servo.prepare(), trained.friction.prepare()
    # kv takes a joint's damping too: they are one number but where the torque is limited
    rows = servo.kp, servo.kd + friction.viscous, trained.armature, friction.coulomb
    start = np.stack([row.detach().numpy() for row in rows])
    is_known = trained.servo.trained.numpy() == 0
    initial = PositionActuators.of_arm(arm, start, np.zeros(n), float(trained.servo.delay))
    steps = max(steps_between(log, TUNING.step) for log, _ in windows.parts)
    windows = replace(windows, steps=steps)
    q, qd = windows.q.numpy(), windows.qd.numpy()

    # unknowns: logarithms of the drives and offsets of commands, (5, n), and the delay, all in one vector
    def actuators(x: np.ndarray) -> PositionActuators:
        drives, offset = np.split(x[:-1].reshape(5, n), [4])
        drives = np.exp(drives)
        drives[0, is_known] = start[0, is_known]
        return replace(initial, drives=drives, offset=offset[0], delay=float(x[-1]))

    def errors(x: np.ndarray) -> np.ndarray:
        """Return errors of positions behind each window's settling, (samples n,)."""
        tried = actuators(x)
        model = tried.model()
        model.opt.timestep = 1 / windows.rate / steps
        commands = windows.commands(tried.delay).numpy() + tried.offset
        missed = _rollout(model, q[:, 0], qd[:, 0], commands) - q[:, 1:]
        judged: np.ndarray = missed[:, windows.settling :].ravel()
        return judged

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.stack([errors(column) for column in x.T], axis=1)

    def jacobian(x: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """Return finite differences; one unknown of all joints is moved at once: it hardly moves other joints."""
        slopes = np.zeros((len(residuals) // n, n, len(x)))
        for columns in (*np.arange(5 * n).reshape(5, n), 5 * n):
            moved = x.ravel().copy()
            moved[columns] += TUNING.nudge
            change = (errors(moved) - residuals.ravel()) / TUNING.nudge
            slopes[:, np.arange(n), columns] = change.reshape(-1, n)
        return slopes.reshape(len(residuals), -1)

    first = np.append(np.log(start), np.zeros(n))
    reach = np.repeat([FARTHEST, OFFSET], [4 * n, n])
    x, _ = minimize.least_squares(
        np.append(first, initial.delay),
        residuals,
        (np.append(first - reach, 0.0), np.append(first + reach, LATEST)),
        jacobian,
        mu_factor=10.0,
        max_iter=TUNING.iterations,
        verbose=minimize.Verbosity.SILENT,
    )
    return actuators(x.ravel())
