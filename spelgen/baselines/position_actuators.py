"""What most people simulate such an arm with: MuJoCo's position actuators, with armature and frictionloss of each
joint. Fitted to the logs that a model of position servos was trained on, they are what it has to beat.

The bodies are the URDF's, and friction is as hard as MuJoCo takes it, as `spelgen export --to mjcf` writes both.
Windows are rolled out by `mujoco.rollout` and fitted by `mujoco.minimize`, which is what `mujoco.sysid` fits with, and
needs none of that package's extra.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import mujoco
import numpy as np
from lxml import etree
from mujoco import minimize, rollout

from spelgen.building import build
from spelgen.exporting.describe import servos_of
from spelgen.exporting.mjcf_file import mjcf_text
from spelgen.exporting.rigid_body_projection import rigid_body_projection
from spelgen.exporting.tip_chain import tip_in_body
from spelgen.fitting.servo_windows import ServoWindows
from spelgen.loaded_arm import LoadedArm
from spelgen.logs.commands import delayed_commands, steps_between
from spelgen.logs.trajectory import Trajectory

STEP = 5e-3  # s, at most
MOST = 60  # windows
ITERATIONS, NUDGE = 8, 1e-4
FARTHEST = 4.0  # of logarithms, from where the fit starts
OFFSET, LATEST = 0.3, 0.4  # rad, m; s: at most
ELSEWHERE = ("include", "asset", "extension", "plugin")  # what MuJoCo would read beside the text


@dataclass(frozen=True)
class PositionActuators:
    """An arm of n joints in MuJoCo, whose actuators get the command of ``delay`` [s] ago, and ``offset`` (n,) more.

    mjcf: the arm with its actuators. joints: (n,) their names, in the order of q.
    """

    mjcf: str
    joints: tuple[str, ...]
    offset: tuple[float, ...]
    delay: float

    @property
    def about(self) -> str:
        """What it is, and how it was fitted."""
        return (
            "position actuators on the URDF's bodies; kp, kv, armature, frictionloss, offsets and delay fitted to "
            "windows of the training logs by mujoco.minimize, the least squares of mujoco.sysid"
        )

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> PositionActuators:
        """What `to_dict` gave. Raises KeyError, TypeError or ValueError where it is something else, or names files."""
        offset, joints = tuple(map(float, record["offset"])), tuple(map(str, record["joints"]))
        found = cls(str(record["mjcf"]), joints, offset, float(record["delay"]))
        root = etree.fromstring(found.mjcf.encode(), etree.XMLParser(resolve_entities=False, no_network=True))
        if any(each.tag in ELSEWHERE for each in root.iter()):
            raise ValueError("MJCF that names other files")
        if not len(offset) == len(joints) == _Simulated(found.mjcf, joints).model.nq:
            raise ValueError("another number of joints")
        return found

    def positions(
        self, parts: Sequence[tuple[Trajectory, slice]], q: np.ndarray, qd: np.ndarray
    ) -> list[np.ndarray]:
        """After each interval of each part of a log (K, n), from q and qd (parts, n), under the log's commands."""
        simulated, found = _Simulated(self.mjcf, self.joints), []
        for k, (log, rows) in enumerate(parts):
            steps = steps_between(log, STEP)
            simulated.model.opt.timestep = float(np.diff(log.t[rows]).mean()) / steps
            commands = delayed_commands(log, rows, self.delay, steps) + self.offset
            found.append(simulated.rolled([simulated.model], q[[k]], qd[[k]], commands[None])[0])
        return found


def fit_position_actuators(arm: LoadedArm, windows: ServoWindows, trained: Any) -> PositionActuators | None:
    """Fitted to windows, starting with the drives of a ``trained`` model of the arm; None where joints are coupled."""
    n, servos = len(arm.arm.coordinates), servos_of(trained)
    bodies, drives = (rigid_body_projection(x, arm) for x in (build(arm, "closed-form"), trained))
    if servos is None or len(arm.arm.bodies) > n or (bodies.motors != np.eye(n)).any():
        return None
    names, tip = tuple(x.name for x in arm.arm.coordinates), tip_in_body(arm)

    def mjcf(kp: np.ndarray, kv: np.ndarray, armature: np.ndarray, dry: np.ndarray) -> str:
        # kv takes a joint's damping too: they are one number but where the torque is limited
        moved = replace(bodies, armature=armature, viscous=np.zeros(n), forward=dry, backward=-dry)
        return mjcf_text(moved, np.eye(n), tip, replace(servos, kp=kp, kd=kv)).decode()

    kd = trained.kd.detach().numpy() + drives.viscous
    start = np.stack([servos.kp, kd, drives.armature, drives.forward])
    steps = max(steps_between(log, STEP) for log, _ in windows.pieces)
    known = (trained.servo.trained == 0).numpy()
    fit = _Fit(_Simulated(mjcf(*start), names), replace(windows, steps=steps), start, known)
    found, offset, delay = fit.solved(servos.delay)
    return PositionActuators(mjcf(*found), names, tuple(offset.tolist()), delay)


class _Simulated:
    """A model in MuJoCo, and where it has the joints."""

    def __init__(self, mjcf: str, joints: Sequence[str]) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf)
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.model.dof_solref[:, 0] = 2 * STEP
        self._data = mujoco.MjData(self.model)
        self.places = [int(self.model.joint(name).dofadr[0]) for name in joints]

    def with_drives(self, drives: np.ndarray) -> mujoco.MjModel:
        """With kp, kv, armature and frictionloss (4, n)."""
        model = copy.copy(self.model)
        kp, kv, armature, dry = drives
        model.actuator_gainprm[:, 0] = kp
        model.actuator_biasprm[:, 1:3] = -np.stack([kp, kv], axis=1)
        model.dof_armature[self.places], model.dof_frictionloss[self.places] = armature, dry
        mujoco.mj_setConst(model, self._data)  # how soft frictionloss is goes by the inertia
        return model

    def rolled(
        self, models: Sequence[mujoco.MjModel], q: np.ndarray, qd: np.ndarray, commands: np.ndarray
    ) -> np.ndarray:
        """Positions (W, K, n) after each interval, from q and qd (W, n), under commands (W, K, S, n) over its steps."""
        n, steps = q.shape[1], commands.shape[2]
        state = np.zeros((len(q), 1 + 2 * n))
        state[:, [1 + x for x in self.places]], state[:, [1 + n + x for x in self.places]] = q, qd
        given = commands.reshape(len(q), -1, n)
        states, _ = rollout.rollout(models, self._data, state, given)
        return np.asarray(states[:, steps - 1 :: steps, [1 + x for x in self.places]])


class _Fit:
    """Unknown are the logarithms of the drives, offsets of commands, (5, n), and the delay, in one vector."""

    def __init__(
        self, simulated: _Simulated, windows: ServoWindows, start: np.ndarray, known: np.ndarray
    ) -> None:
        """start: drives (4, n); known: whose kp stays, (n,)."""
        self._simulated, self._windows = simulated, windows
        self._start, self._known = start, known
        simulated.model.opt.timestep = 1 / windows.rate / windows.steps

    def solved(self, delay: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Drives (4, n), offsets (n,) and the delay: least squares of what follows each window's settling."""
        n = self._start.shape[1]
        start = np.concatenate([np.log(self._start).ravel(), np.zeros(n), [delay]])
        away = np.concatenate([np.full(4 * n, FARTHEST), np.full(n, OFFSET)])
        least, most = np.append(start[:-1] - away, 0.0), np.append(start[:-1] + away, LATEST)
        x, _ = minimize.least_squares(
            start, self._residuals, (least, most), self._slopes,
            mu_factor=10.0, max_iter=ITERATIONS, verbose=minimize.Verbosity.SILENT,
        )  # fmt: skip
        drives, offset, delay = self._parts(x.ravel())
        return drives, offset, delay

    def _parts(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        *drives, offset = x[:-1].reshape(5, -1)
        found = np.exp(drives)
        found[0] = np.where(self._known, self._start[0], found[0])
        return found, offset, float(x[-1])

    def _residuals(self, x: np.ndarray) -> np.ndarray:
        """Of one vector, or of the columns of several."""
        return np.stack([each.ravel() for each in self._errors(x.T)], axis=1)

    def _slopes(self, x: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """By columns. One unknown of all joints is moved at once: what moves a joint hardly moves the others."""
        n = self._start.shape[1]
        moves = np.zeros((6, x.size))
        for k in range(5):
            moves[k, k * n : (k + 1) * n] = NUDGE
        moves[5, -1] = NUDGE
        errors = residuals.reshape(-1, n)
        moved = self._errors(x.T + moves).reshape(6, -1, n)
        slopes = (moved - errors) / NUDGE
        own = np.einsum("kmj,ji->mjki", slopes[:5], np.eye(n)).reshape(errors.size, -1)
        return np.concatenate([own, slopes[5].reshape(-1, 1)], axis=1)

    def _errors(self, vectors: np.ndarray) -> np.ndarray:
        """Of each vector, (P, W, K', n)."""
        windows, models, commands = self._windows, [], []
        q, qd = windows.q.numpy(), windows.qd.numpy()
        for vector in vectors:
            drives, offset, delay = self._parts(vector)
            models += [self._simulated.with_drives(drives)] * len(q)
            commands.append(windows.commands(delay).numpy() + offset)
        start, velocity = (np.tile(each[:, 0], (len(vectors), 1)) for each in (q, qd))
        found = self._simulated.rolled(models, start, velocity, np.concatenate(commands))
        errors: np.ndarray = found.reshape(len(vectors), len(q), -1, q.shape[2]) - q[:, 1:]
        return errors[:, :, windows.settling :]
