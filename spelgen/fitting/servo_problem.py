"""The rollout of windows under their commands as a function of a model's weights, and its derivatives by them.

Each joint is rolled out by itself under the load of the bodies, so one weight of every joint is moved at once; weights
that all joints share, those of the bodies and the delay, are moved one after the other, all in one rollout.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.func import functional_call

from spelgen.dynamics.servo_rollout import Load, ServoDrives, advanced, balanced, servo_drives
from spelgen.fitting.functional_model import FunctionalModel
from spelgen.fitting.servo_weights import BODIES, Point, ServoWeights, body_directions, inertial_slopes
from spelgen.fitting.servo_windows import BodyLoad, Path, ServoWindows, body_load

NUDGE = 1e-4  # of weights
DELAY_NUDGE = 2e-4  # s
STILL = 1e-9  # rad/s, m/s: so that there is friction of joints that never move
GRAVITY_SAMPLES = 2000  # for the directions of the bodies


class ServoProblem:
    """Windows, a model, and the errors that it makes on them with these weights."""

    def __init__(self, model: Any, windows: ServoWindows) -> None:
        self.model, self.windows = model, windows
        self.weights = ServoWeights(model)
        self._asked = FunctionalModel(model)
        q = windows.q.flatten(0, 1)
        self.directions = body_directions(model, q[:: max(1, len(q) // GRAVITY_SAMPLES)])
        self._raw = model.get_parameter(BODIES).detach().clone()
        bodies = torch.zeros(self.directions.shape[1]).double()
        self.start = Point(self.weights.read(), bodies, float(model.servo.delay), self.weights.present)
        self.nudge = NUDGE
        self.relinearise(self.start, windows.path())

    def relinearise(self, point: Point, path: Path) -> None:
        """Take the bodies as they are at this point, moving along this path."""
        self.write(point)
        self._at, self.along = point.bodies, path
        self.load: BodyLoad = body_load(self.model, path, inertial_slopes(self.model) @ self.directions)

    def write(self, point: Point) -> None:
        """Put weights into the model."""
        self.weights.write(point)
        bodies = self._raw + (self.directions @ point.bodies).view_as(self._raw)
        with torch.no_grad():
            self.model.get_parameter(BODIES).copy_(bodies)
            self.model.servo.delay.fill_(point.delay)

    def errors(self, point: Point) -> torch.Tensor:
        """Predicted less measured positions (W, K', n), all samples after the windows' settling."""
        return self._errors(self._rolled(point, *self._where(point))[0])[0]

    def path(self, point: Point) -> Path:
        """The measured motion, whose derivatives are the predicted ones and those of what prediction misses."""
        q, qd = (x[0] for x in self._rolled(point, *self._where(point)))
        return self.windows.path(q, qd)

    def slopes(self, point: Point, errors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the errors (W, K', n), by the joints' weights (p, W, K', n), and by those that all share (r + 1, ...)."""
        joints, bodies, commands = self._where(point)
        own, r = self._nudged(point), len(point.bodies)
        p = len(own)
        own = torch.cat([own, joints.expand(r + 1, -1, -1)])
        shared = torch.cat([bodies.expand(p, -1), bodies + self.nudge * torch.eye(r).double(), bodies])
        late = self.windows.commands(point.delay + DELAY_NUDGE).unsqueeze(0)
        every = torch.cat([commands.expand(p + r, -1, -1, -1, -1), late])
        found = self._errors(self._rolled(point, own, shared, every)[0]) - errors
        return self._by_joint(point, found[:p]), torch.cat(
            [found[p:-1] / self.nudge, found[-1:] / DELAY_NUDGE]
        )

    def joint_slopes(self, point: Point, errors: torch.Tensor) -> torch.Tensor:
        """Of the errors (W, K', n), by the joints' weights alone, (p, W, K', n)."""
        own, (_, bodies, commands) = self._nudged(point), self._where(point)
        shape = (len(own), *commands.shape[1:])
        q, _ = self._rolled(point, own, bodies.expand(len(own), -1), commands.expand(shape))
        return self._by_joint(point, self._errors(q) - errors)

    def _nudged(self, point: Point) -> torch.Tensor:
        """Weights of joints, of which one after the other that any joint has is moved, (p', p, n)."""
        return point.joints + self.nudge * torch.eye(len(point.joints)).double()[_rows(point)].unsqueeze(-1)

    def _by_joint(self, point: Point, changes: torch.Tensor) -> torch.Tensor:
        slopes = torch.zeros(len(point.joints), *changes.shape[1:]).double()
        slopes[_rows(point)] = changes / self.nudge
        return slopes

    def _where(self, point: Point) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Weights of joints (1, p, n), of bodies (1, r), commands (1, W, K, S, n)."""
        commands = self.windows.commands(point.delay)
        return point.joints.unsqueeze(0), point.bodies.unsqueeze(0), commands.unsqueeze(0)

    def _errors(self, q: torch.Tensor) -> torch.Tensor:
        judged = self.windows.settling + 1
        return q[:, :, judged:] - self.windows.q[:, judged:]

    def _rolled(
        self, point: Point, joints: torch.Tensor, bodies: torch.Tensor, commands: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """q and qd (P, W, K, n) at all samples, of weights (P, p, n), (P, r) under commands (P, W, K-1, S, n)."""
        named = self.weights.named(joints, point.present)
        weights = {f"model.{name}": x.detach() for name, x in named.items()}
        with torch.inference_mode():  # small operations, of which each takes a tenth less so
            drives, armature = functional_call(self._asked, weights, (_drives,))
            added = torch.einsum("wknr,pr->pwkn", self.load.weights, bodies - self._at)
            return self._integrated(drives, armature, added, commands)

    def _integrated(
        self, drives: ServoDrives, armature: torch.Tensor, added: torch.Tensor, commands: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        windows, load = self.windows, self.load
        h = windows.dt.unsqueeze(-1) / windows.steps
        inertia, bias = load.inertia + armature.unsqueeze(-2), load.bias + added
        shape = (len(added), *windows.q[:, 0].shape)
        q, qd = windows.q[:, 0].expand(shape), windows.qd[:, 0].expand(shape)
        found, state = [(q, qd)], None
        for k in range(windows.q.shape[1] - 1):
            now = Load(inertia[:, :, k], bias[:, :, k], load.gravity[:, k], coupled=False)
            if state is None:
                state = balanced(drives, q, qd, commands[:, :, k, 0], now)
            for u in commands[:, :, k].unbind(2):
                state = advanced(drives, state, u, now, h[:, k])
            found.append((state.q, state.qd))
        return torch.stack([x for x, _ in found], dim=2), torch.stack([x for _, x in found], dim=2)


def _drives(model: Any) -> tuple[ServoDrives, torch.Tensor]:
    return servo_drives(model), model.armature


def _rows(point: Point) -> torch.Tensor:
    """Of weights that any joint has."""
    return point.present.any(dim=1).nonzero().squeeze(-1)


def sliding_friction(friction: Any, qd: torch.Tensor, gravity: torch.Tensor) -> torch.Tensor:
    """Dry friction of each joint, (n,) [Nm, N], over what it went; qd and gravity's torque: (..., n)."""
    way = qd.abs() + STILL
    dry = friction.dry(qd, gravity, friction.prepare()) * way
    found: torch.Tensor = dry.flatten(0, -2).sum(dim=0) / way.flatten(0, -2).sum(dim=0)
    return found
