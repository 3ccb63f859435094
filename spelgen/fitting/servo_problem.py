"""The rollout of windows under their commands as a function of a model's weights, and its derivatives by them.

Each joint is rolled out by itself, so one weight of every joint is moved at once; weights that all joints share, those
of the bodies' weight and the delay, are moved one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch.func import functional_call, jacfwd

from spelgen.dynamics.servo_rollout import Drives, Load, advanced, balanced, drives_of
from spelgen.fitting.servo_windows import BodyLoad, ServoWindows, body_load
from spelgen.fitting.torque_jacobian import Asked

DEVIATIONS = {
    "servo.raw_kp": 3.0,
    "servo.raw_kd": 2.0,
    "dynamics.armature.raw": 2.0,
    "dynamics.raw_offset": 2.0,
    "dynamics.friction.raw_coulomb": 2.0,
    "dynamics.friction.raw_stribeck": 2.0,
    "dynamics.friction.raw_stribeck_velocity": 1.0,
    "dynamics.friction.raw_load_dependence": 2.0,
    "dynamics.friction.raw_bristle_fractions": 2.0,
}
"""Weights of joints that are fitted, with the standard deviations of their Gaussian prior."""
BODIES = "dynamics.inertial_parameters.raw"
BODY_DEVIATION = 0.3  # of the bodies' weights, which is some 60 % in mass
DIRECTIONS = 6  # of the bodies' weights, those that move gravity most
DELAY_DEVIATION = 0.1  # s
NUDGE, DELAY_NUDGE = 1e-4, 2e-4  # s


@dataclass(frozen=True, eq=False)
class Point:
    """Weights of joints (p, n), along directions of bodies (r,), and the delay [s]."""

    joints: torch.Tensor
    bodies: torch.Tensor
    delay: float

    def moved(self, step: torch.Tensor) -> Point:
        """One step on."""
        joints, bodies, delay = step.split([self.joints.numel(), len(self.bodies), 1])
        later = max(0.0, self.delay + float(delay))
        return Point(self.joints + joints.view_as(self.joints), self.bodies + bodies, later)

    @property
    def flat(self) -> torch.Tensor:
        """All in one."""
        delay = torch.tensor([self.delay], dtype=torch.float64)
        return torch.cat([self.joints.flatten(), self.bodies, delay])


class ServoProblem:
    """Windows, a model, and the errors that it makes on them with these weights."""

    def __init__(self, model: Any, windows: ServoWindows) -> None:
        self.model, self.windows = model, windows
        self._asked = Asked(model)
        parameters = dict(model.named_parameters())
        self.names = [
            (name, k)
            for name in DEVIATIONS
            for k in range(parameters[name].flatten(1).shape[1] if parameters[name].dim() > 1 else 1)
        ]
        self.start = self._joints()
        self.relinearise()

    def relinearise(self) -> Point:
        """Take the bodies as the model has them now; the point where it stands."""
        self.raw = self.model.get_parameter(BODIES).detach().clone()
        self.directions, ten = self._directions()
        self.load: BodyLoad = body_load(self.model, self.windows, ten)
        return Point(
            self._joints(), torch.zeros(self.directions.shape[1]).double(), float(self.model.servo.delay)
        )

    def deviations(self) -> torch.Tensor:
        """Of the prior, as `Point.flat`."""
        own = torch.tensor([DEVIATIONS[name] for name, _ in self.names]).double()
        bodies = torch.ones(self.directions.shape[1]).double()
        delay = torch.tensor([DELAY_DEVIATION]).double()
        return torch.cat([own.repeat_interleave(self.model.n), bodies, delay])

    def write(self, point: Point) -> None:
        """Put weights into the model."""
        parameters = dict(self.model.named_parameters())
        with torch.no_grad():
            for name, rows in self._named(point.joints.unsqueeze(0)).items():
                parameters[name].copy_(rows[0, 0])
            parameters[BODIES].copy_(self.raw + (self.directions @ point.bodies).view_as(self.raw))
            self.model.servo.delay.fill_(point.delay)

    def errors(self, point: Point) -> torch.Tensor:
        """Predicted less measured positions (M, n), all samples after the windows' settling."""
        commands = self.windows.commands(point.delay)
        return self._errors(point.joints.unsqueeze(0), self._gravity(point.bodies.unsqueeze(0)), commands)[0]

    def slopes(self, point: Point, errors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the errors (M, n), by the joints' weights (p, M, n), and by those that all share (r + 1, M, n)."""
        commands, p, r = self.windows.commands(point.delay), len(point.joints), len(point.bodies)
        added = self._gravity(point.bodies.unsqueeze(0))
        nudged = point.joints + NUDGE * torch.eye(p).double().unsqueeze(-1)
        own = (self._errors(nudged, added, commands) - errors) / NUDGE
        weights = self._gravity(point.bodies + NUDGE * torch.eye(r).double())
        shared = (self._errors(point.joints.unsqueeze(0), weights, commands) - errors) / NUDGE
        later = self.windows.commands(point.delay + DELAY_NUDGE)
        late = (self._errors(point.joints.unsqueeze(0), added, later) - errors) / DELAY_NUDGE
        return own, torch.cat([shared, late])

    def _joints(self) -> torch.Tensor:
        parameters = dict(self.model.named_parameters())
        rows = [parameters[name].detach() for name in DEVIATIONS]
        return torch.cat([x.unsqueeze(0) if x.dim() == 1 else x.mT for x in rows]).clone()

    def _named(self, joints: torch.Tensor) -> dict[str, torch.Tensor]:
        """Weights by name, (P, 1, n) or (P, 1, n, K), of (P, p, n)."""
        found: dict[str, list[torch.Tensor]] = {}
        for (name, _), row in zip(self.names, joints.unsqueeze(2).unbind(1), strict=True):
            found.setdefault(name, []).append(row)
        several = {name for name, x in self.model.named_parameters() if x.dim() > 1}
        return {k: torch.stack(x, dim=-1) if k in several else x[0] for k, x in found.items()}

    def _gravity(self, bodies: torch.Tensor) -> torch.Tensor:
        """What directions of the bodies' weights (P, r) add to gravity, (P, W, K, n)."""
        return torch.einsum("wknr,pr->pwkn", self.load.weights, bodies)

    def _directions(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Directions of the bodies' weights that move gravity most, (10 B, r), and of their ten parameters."""
        bodies = self.model.dynamics.inertial_parameters

        def ten(raw: torch.Tensor) -> torch.Tensor:
            found: torch.Tensor = functional_call(bodies, {"raw": raw.view_as(self.raw)}, ()).flatten()
            return found

        change = BODY_DEVIATION * jacfwd(ten)(self.raw.flatten()).detach()
        q = self.windows.q.flatten(0, 1)[:: max(1, self.windows.q[..., 0].numel() // 2000)]
        with torch.no_grad():
            gravity = self.model.dynamics.regressor(q, torch.zeros_like(q), torch.zeros_like(q)) @ change
        _, sizes, turned = torch.linalg.svd(gravity.flatten(0, 1), full_matrices=False)
        most = int((sizes > 1e-3 * sizes[0].clamp(min=1e-12)).sum()) if len(sizes) else 0
        chosen = turned[: min(most, DIRECTIONS)].mT
        return BODY_DEVIATION * chosen, change @ chosen

    def _errors(self, joints: torch.Tensor, added: torch.Tensor, commands: torch.Tensor) -> torch.Tensor:
        """Errors (P, M, n) with weights of joints (P, p, n) and more gravity (P, W, K, n); each P may be 1."""
        weights = {f"model.{name}": x.detach() for name, x in self._named(joints).items()}
        with torch.no_grad():
            drives, armature = functional_call(self._asked, weights, (_drives,))
            return self._rolled(drives, armature, added, commands).flatten(1, 2)

    def _rolled(
        self, drives: Drives, armature: torch.Tensor, added: torch.Tensor, commands: torch.Tensor
    ) -> torch.Tensor:
        windows, load = self.windows, self.load
        h = windows.dt.unsqueeze(-1) / windows.steps
        inertia, bias, gravity = (
            load.inertia + armature.unsqueeze(-2),
            load.bias + added,
            load.gravity + added,
        )
        found, state = [], None
        shape = (max(len(armature), len(added)), *windows.q[:, 0].shape)
        for k in range(windows.q.shape[1] - 1):
            between = (bias[:, :, k] + bias[:, :, k + 1]) / 2
            now = Load(inertia[:, :, k], between, gravity[:, :, k], coupled=False)
            if state is None:
                q, qd = (x[:, 0].expand(shape) for x in (windows.q, windows.qd))
                state = balanced(drives, q, qd, commands[:, k, 0], now)
            for u in commands[:, k].unbind(1):
                state = advanced(drives, state, u, now, h[:, k])
            if k >= windows.settling:
                found.append(state.q - windows.q[:, k + 1])
        return torch.stack(found, dim=2)  # (P, W, K', n)


def _drives(model: Any) -> tuple[Drives, torch.Tensor]:
    return drives_of(model), model.dynamics.armature()
