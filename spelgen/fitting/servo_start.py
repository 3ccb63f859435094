"""Where a fit of servos starts: least squares on the command error.

At a joint that a servo holds, kp (u - q) = kd qd + M qdd + gravity + friction: divided by kp, the distance from the
command is linear in what is unknown, and its slope by the gravity torque of the URDF's masses is 1 / kp.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.fitting.servo_windows import BodyLoad, ServoWindows

TOLD = 8.0  # standard deviations: gravity tells kp
RANGE = 20.0  # a kp further from where it starts is not believed
LEAST = 0.05  # of a usual size, so that its logarithm is one


def start_servos(model: Any, windows: ServoWindows, load: BodyLoad, delay: float) -> None:
    """Give kp, kd, armature, friction and offset of the model the values that explain the command error best."""
    dynamics, servo = model, model.servo
    n = model.n
    u = windows.commands(delay).mean(dim=2)
    z = np.stack([bristles_along(x.numpy(), bristle_reach(model)) for x in windows.q])
    direction = torch.from_numpy(z / dynamics.friction.bristles.reach.numpy()).mean(dim=-1)
    rows = slice(windows.settling, None)
    error = (u - windows.q[:, :-1])[:, windows.settling :]
    path = windows.path()
    columns = [x[:, rows] for x in (path.qd, path.qdd, direction[:, :-1], load.bias)]
    found = [
        _solved(torch.stack([*(x[..., k] for x in columns), torch.ones_like(error[..., k])]), error[..., k])
        for k in range(n)
    ]
    slopes, told = torch.stack([x[0] for x in found]), torch.stack([x[1] for x in found])
    with torch.no_grad():
        nominal, known = servo.nominal_kp, servo.trained == 0
        kp = 1 / slopes[:, 3].clamp(min=1e-12)
        believed = (told[:, 3] > TOLD) & (kp < RANGE * nominal) & (kp > nominal / RANGE) & ~known
        common = (kp / nominal)[believed].median() if believed.any() else torch.ones(()).double()
        kp = torch.where(known, nominal, torch.where(believed, kp, common * nominal))
        size, own = dynamics.friction.nominal, load.inertia.mean(dim=(0, 1))
        servo.raw_kp.copy_(torch.where(known, torch.zeros_like(kp), (kp / nominal).log()))
        servo.raw_kd.copy_((torch.maximum(kp * slopes[:, 0], LEAST**2 * kp) / servo.nominal_kd).log())
        armature = torch.maximum(kp * slopes[:, 1] - own, LEAST**3 * kp)
        dynamics.rotors.raw.copy_((armature / dynamics.rotors.nominal).log())
        friction = dynamics.friction
        friction.raw_coulomb.copy_((torch.maximum(kp * slopes[:, 2], LEAST * size) / size).log())
        # a drive's viscous friction and kd are one number: kd has it all
        friction.raw_viscous.fill_(-6.0)
        friction.raw_saturation.fill_(-6.0)
        dynamics.raw_offset.copy_((kp * slopes[:, 4] / size).clamp(-2.0, 2.0))


def _solved(columns: torch.Tensor, error: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Slopes (5,) and how many standard deviations they are, of neighbours that err alike."""
    rows = columns.flatten(1).mT
    # torch leaves the pivots of its default driver to chance
    found = torch.linalg.lstsq(rows, error.flatten().unsqueeze(-1), driver="gelsd")
    slopes = found.solution.squeeze(-1)
    rest = error.flatten() - rows @ slopes
    alike = error.shape[1]
    variance = rest.square().mean() * torch.linalg.pinv(rows.mT @ rows).diagonal() * alike
    return slopes, slopes / variance.clamp(min=1e-300).sqrt()
