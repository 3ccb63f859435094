"""Fit MuJoCo's position actuators, with which most people simulate such an arm.

Armature and frictionloss of each joint are fitted too. Fitted to the logs that a model of position servos was trained
on, they are what it has to beat.

The bodies are the URDF's, and friction is as hard as MuJoCo takes it, as `spelgen export --to mjcf` writes both.
Windows are rolled out by `mujoco.rollout` and fitted by `mujoco.minimize`, which is what `mujoco.sysid` fits with, and
needs none of that package's extra.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from lxml import etree
from mujoco import minimize, rollout

from spelgen.building import build
from spelgen.exporting.describe import servos_of
from spelgen.exporting.mjcf_file import mjcf_text
from spelgen.exporting.rigid_body_projection import rigid_body_projection
from spelgen.exporting.tip_frame import tip_frame
from spelgen.fitting.servo.windows import ServoWindows
from spelgen.loaded_arm import LoadedArm
from spelgen.logs.commands import LogRows, delayed_commands, steps_between
from spelgen.settings.tuning.servo import PositionActuatorTuning

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

TUNING = PositionActuatorTuning()
FARTHEST, OFFSET, LATEST = 4.0, 0.3, 0.4  # bounds: of logarithms from their start; rad, m; s
OTHER_FILES = ("include", "asset", "extension", "plugin")  # what MuJoCo would read beside the text


@dataclass(frozen=True)
class PositionActuators:
    """Predict an arm of n joints in MuJoCo, whose actuators get the command of ``delay`` [s] ago, and ``offset`` (n,).

    mjcf: the arm with its actuators. joints: (n,) their names, in the order of q.
    """

    mjcf: str
    joints: tuple[str, ...]
    offset: tuple[float, ...]
    delay: float
    about = (
        "position actuators on the URDF's bodies; kp, kv, armature, frictionloss, offsets and delay fitted to windows "
        "of the training logs by mujoco.minimize, the least squares of mujoco.sysid"
    )

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return asdict(self)

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> PositionActuators:
        """Read what `to_dict` gave. Raises KeyError, TypeError or ValueError for something else, or other files."""
        offset, joints = tuple(map(float, record["offset"])), tuple(map(str, record["joints"]))
        actuators = cls(str(record["mjcf"]), joints, offset, float(record["delay"]))
        parser = etree.XMLParser(resolve_entities=False, no_network=True)
        for element in etree.fromstring(actuators.mjcf.encode(), parser).iter(*OTHER_FILES):
            raise ValueError(f"MJCF that names other files: {element.tag}")
        if not len(offset) == len(joints) == _Simulation(actuators.mjcf, joints).model.nq:
            raise ValueError("another number of joints")
        return actuators

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return positions (K, n) after each interval of each part of a log, from q and qd (parts, n)."""
        simulation, positions = _Simulation(self.mjcf, self.joints), []
        for k, (log, rows) in enumerate(parts):
            steps = steps_between(log, TUNING.step)
            simulation.model.opt.timestep = float(np.diff(log.t[rows]).mean()) / steps
            commands = delayed_commands(log, rows, self.delay, steps) + self.offset
            positions += [*simulation.rollout([simulation.model], q[[k]], qd[[k]], commands[None])]
        return positions


def fit_position_actuators(
    arm: LoadedArm, windows: ServoWindows, trained: EmittedModel
) -> PositionActuators | None:
    """Fit to windows, starting with the drives of a ``trained`` model of the arm; None where joints are coupled."""
    n, servos = len(arm.arm.coordinates), servos_of(trained)
    bodies, drives = (
        rigid_body_projection(build(arm, "closed-form"), arm),
        rigid_body_projection(trained, arm),
    )
    if servos is None or len(arm.arm.bodies) > n or (bodies.motors != np.eye(n)).any():
        return None
    names, tip = arm.arm.joint_names, tip_frame(arm)

    def mjcf(kp: np.ndarray, kv: np.ndarray, armature: np.ndarray, dry: np.ndarray) -> str:
        # kv takes a joint's damping too: they are one number but where the torque is limited
        moved = replace(bodies, armature=armature, viscous=np.zeros(n), forward=dry, backward=-dry)
        return mjcf_text(moved, np.eye(n), tip, replace(servos, kp=kp, kd=kv)).decode()

    kv = trained.kd.detach().numpy() + drives.viscous
    start = np.stack([servos.kp, kv, drives.armature, drives.forward])
    steps = max(steps_between(log, TUNING.step) for log, _ in windows.parts)
    problem = _Problem(
        _Simulation(mjcf(*start), names),
        replace(windows, steps=steps),
        start,
        (trained.servo.trained == 0).numpy(),
    )
    fitted, offset, delay = problem.solve(servos.delay)
    return PositionActuators(mjcf(*fitted), names, tuple(offset.tolist()), delay)


class _Simulation:
    """Roll out a model of MuJoCo, whose joints come in any order."""

    def __init__(self, mjcf: str, joints: Sequence[str]) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf)
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.model.dof_solref[:, 0] = 2 * TUNING.step
        self._data = mujoco.MjData(self.model)
        self._columns = np.array([int(self.model.joint(name).dofadr[0]) for name in joints])

    def with_drives(self, drives: np.ndarray) -> mujoco.MjModel:
        """Return the model with kp, kv, armature and frictionloss (4, n)."""
        model = copy.copy(self.model)
        kp, kv, armature, dry = drives
        model.actuator_gainprm[:, 0] = kp
        model.actuator_biasprm[:, 1:3] = -np.stack([kp, kv], axis=1)
        model.dof_armature[self._columns] = armature
        model.dof_frictionloss[self._columns] = dry
        mujoco.mj_setConst(model, self._data)  # how soft frictionloss is goes by the inertia
        return model

    def rollout(
        self, models: Sequence[mujoco.MjModel], q: np.ndarray, qd: np.ndarray, commands: np.ndarray
    ) -> np.ndarray:
        """Return positions (W, K, n) after each interval, from q and qd (W, n), under commands (W, K, S, n)."""
        count, _, steps, n = commands.shape
        state = np.zeros((count, 1 + 2 * n))  # time, q, qd
        state[:, 1 + self._columns] = q
        state[:, 1 + n + self._columns] = qd
        states, _ = rollout.rollout(models, self._data, state, commands.reshape(count, -1, n))
        return np.asarray(states[:, steps - 1 :: steps, 1 + self._columns])


class _Problem:
    """Fit logarithms of the drives and offsets of commands, (5, n), and the delay, all in one vector."""

    def __init__(
        self, simulation: _Simulation, windows: ServoWindows, start: np.ndarray, known: np.ndarray
    ) -> None:
        """start: drives (4, n); known: whose kp stays, (n,)."""
        self._simulation, self._windows = simulation, windows
        self._start, self._known = start, known
        simulation.model.opt.timestep = 1 / windows.rate / windows.steps

    def solve(self, delay: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Return drives (4, n), offsets (n,) and the delay: least squares of what follows each window's settling."""
        n = self._start.shape[1]
        start = np.concatenate([np.log(self._start).ravel(), np.zeros(n)])
        reach = np.repeat([FARTHEST, OFFSET], [4 * n, n])
        x, _ = minimize.least_squares(
            np.append(start, delay), self._residuals,
            (np.append(start - reach, 0.0), np.append(start + reach, LATEST)), self._jacobian,
            mu_factor=10.0, max_iter=TUNING.iterations, verbose=minimize.Verbosity.SILENT,
        )  # fmt: skip
        return self._split(x.ravel())

    def _split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        drives, offset = np.split(x[:-1].reshape(5, -1), [4])
        drives = np.exp(drives)
        drives[0, self._known] = self._start[0, self._known]
        return drives, offset[0], float(x[-1])

    def _residuals(self, x: np.ndarray) -> np.ndarray:
        """Return those of the columns of x."""
        return np.stack([self._errors(column).ravel() for column in x.T], axis=1)

    def _jacobian(self, x: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """Return finite differences; one unknown of all joints is moved at once: it hardly moves other joints."""
        n, nudge = self._start.shape[1], TUNING.nudge
        jacobian = np.zeros((residuals.size, x.size))
        for columns in [*np.arange(5 * n).reshape(5, n), np.array([5 * n])]:
            moved = x.ravel().copy()
            moved[columns] += nudge
            slopes = (self._errors(moved) - residuals.reshape(-1, n)) / nudge
            for joint in range(n):
                jacobian[joint::n, columns[joint % len(columns)]] = slopes[:, joint]
        return jacobian

    def _errors(self, x: np.ndarray) -> np.ndarray:
        """Return those of positions, (samples, n)."""
        windows, (drives, offset, delay) = self._windows, self._split(x)
        q, commands = windows.q.numpy(), windows.commands(delay).numpy() + offset
        models = [self._simulation.with_drives(drives)] * len(q)
        predicted = self._simulation.rollout(models, q[:, 0], windows.qd[:, 0].numpy(), commands)
        errors: np.ndarray = (predicted - q[:, 1:])[:, windows.settling :]
        return errors.reshape(-1, q.shape[2])
