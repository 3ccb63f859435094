"""Start a fit of servos by least squares on the command error.

At a joint that a servo holds, kp (u - q) = kd qd + M qdd + gravity + friction: divided by kp, the distance from the
command is linear in what is unknown, and its slope by the gravity torque of the URDF's masses is 1 / kp.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.fitting.servo.tuning import ServoStartTuning
from spelgen.fitting.servo.windows import ServoWindows, body_load

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

TUNING = ServoStartTuning()
NONE, FAINT = -6.0, -2.0  # logarithms, of the usual sizes


def start_servos(model: ArmModel, windows: ServoWindows) -> None:
    """Give kp, kd, armature, friction and offset of the model the values that explain the command error best."""
    delay = 1 / windows.rate
    model.servo.delay.fill_(delay)
    friction, servo = model.friction, model.servo
    path = windows.path()
    load = body_load(model, path)
    bristles = np.stack([bristles_along(q.numpy(), bristle_reach(model)) for q in windows.q])
    direction = (torch.from_numpy(bristles) / friction.reach).mean(dim=-1)[:, :-1]
    columns = torch.stack([path.qd, path.qdd, direction, load.bias, torch.ones_like(direction)], dim=-1)
    error = windows.commands(delay).mean(dim=2) - windows.q[:, :-1]
    slopes, significance = _regression(columns[:, windows.settling :], error[:, windows.settling :])
    damping, inertia, dry, compliance, offset = slopes.unbind(-1)
    with torch.no_grad():
        known = servo.trained == 0
        factor = 1 / (compliance * servo.nominal_kp).clamp(min=1e-12)
        # gravity determines kp of joints that it loads; the others' are off by the same factor
        clear = ~known & (significance[:, 3] > TUNING.significance)
        clear &= factor.log().abs() < np.log(TUNING.kp_range)
        common = torch.ones(()).double()
        if clear.any():
            common = factor[clear].median()
        factor = torch.where(clear, factor, common)
        factor[known] = 1.0
        kp, least = factor * servo.nominal_kp, TUNING.least
        servo.raw_kp.copy_(factor.log())
        servo.raw_kd.copy_((kp * damping.clamp(min=least**2) / servo.nominal_kd).log())
        armature = torch.maximum(kp * inertia - load.inertia.mean(dim=(0, 1)), least**3 * kp)
        model.raw_armature.copy_((armature / model.nominal_armature).log())
        friction.raw_coulomb.copy_((kp * dry / friction.nominal).clamp(min=least).log())
        # a drive's viscous friction and kd are one number: kd has it all
        friction.raw_viscous.fill_(NONE)
        friction.raw_saturation.fill_(NONE)
        friction.raw_stribeck.fill_(FAINT)
        model.raw_offset.copy_((kp * offset / friction.nominal).clamp(-2.0, 2.0))


def _regression(columns: torch.Tensor, errors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return slopes of errors (W, K, n) by columns (W, K, n, 5), and how many standard deviations they are, (n, 5).

    Samples of a window are taken to say the same.
    """
    matrix = columns.flatten(0, 1).transpose(0, 1)  # (n, M, 5)
    target = errors.flatten(0, 1).mT.unsqueeze(-1)
    # torch leaves the pivots of its default driver to chance
    slopes = torch.linalg.lstsq(matrix, target, driver="gelsd").solution
    residual = target - matrix @ slopes
    spread = torch.linalg.pinv(matrix.mT @ matrix).diagonal(dim1=-2, dim2=-1)
    variance = residual.square().mean(dim=1) * spread * errors.shape[1]
    slopes = slopes.squeeze(-1)
    return slopes, slopes / variance.clamp(min=1e-300).sqrt()
