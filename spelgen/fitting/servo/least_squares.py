"""Least-squares fits to windows: the initial guess of a servo fit, and the baseline of linear second-order servos.

The initial guess is the linear least-squares solution for the command error u - q, the commanded minus the measured
position. At a joint with a position servo,

    kp (u - q) = kd qd + M qdd + gravity + friction.

The command error is therefore linear in the ratios of the parameters to kp. The gravity torque is computed with the
URDF's masses: its coefficient is 1 / kp.
"""

from functools import lru_cache

import numpy as np
import torch
from scipy.optimize import least_squares, minimize_scalar
from torch import Tensor

from spelgen.baselines.linear_servos import LinearServos, linear_response
from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic
from spelgen.fitting.servo.tuning import TUNING
from spelgen.fitting.servo.windows import ServoWindows, body_load


def set_initial_guess(model: ArmModel, windows: ServoWindows) -> list[Diagnostic]:
    """Set kp, kd, armature, friction and offset of the model by linear regression of the command error u - q.

    u is the commanded, q the measured position. See the top of this module for the equation. Effort limits of the URDF
    are placeholders in many files. Nominal friction is therefore scaled like kp, and a limit that the servo torques of
    the logs exceed is removed. Return a warning about removed limits, if there are any.
    """
    delay = 1 / windows.rate
    model.servo.delay.fill_(delay)
    friction, servo = model.friction, model.servo
    motion = windows.motion()
    load = body_load(model, motion)
    bristles = np.stack([bristles_along(q.numpy(), bristle_reach(model)) for q in windows.q])
    direction = (torch.from_numpy(bristles) / friction.reach).mean(dim=-1)[:, :-1]
    columns = torch.stack([motion.qd, motion.qdd, direction, load.bias, torch.ones_like(direction)], dim=-1)
    error = windows.commands(delay).mean(dim=2) - windows.q[:, :-1]
    coefficients, significance = _regression(columns[:, windows.burn_in :], error[:, windows.burn_in :])
    damping, inertia, dry, compliance, offset = coefficients.unbind(-1)
    with torch.no_grad():
        is_known, smallest = servo.trained == 0, TUNING.min_friction
        moving = windows.moving
        factor = 1 / (compliance * servo.nominal_kp).clamp(min=1e-12)
        # The coefficient of the gravity load, 1 / kp, determines kp / nominal kp only at joints that carry such a load.
        # The other joints have the median of this factor, but carry their load: kp is at least gravity torque / error.
        loaded = ~is_known & moving & (compliance > 0) & (significance[:, 3] > TUNING.kp_significance)
        if loaded.any():
            loaded &= (factor / factor[loaded].median()).log().abs() < np.log(TUNING.kp_range)
        torque_error = error - damping * motion.qd
        squares = [x.square().mean(dim=(0, 1)) for x in (load.gravity, torque_error)]
        # Friction of a joint at rest may carry the load without any error.
        carried = (squares[0] / squares[1].clamp(min=TUNING.min_motion**2)).sqrt() / servo.nominal_kp
        typical = factor[loaded].median() if loaded.any() else carried.max()
        unloaded = carried.maximum(typical if typical > 1e-6 else torch.ones(1))
        factor = torch.where(loaded, factor, unloaded).masked_fill(is_known, 1.0)
        kp = factor * servo.nominal_kp
        friction.nominal.mul_(factor)
        servo.raw_kp.copy_(factor.log())
        servo.raw_kd.copy_((kp * damping.clamp(min=smallest**2) / servo.nominal_kd).log())
        armature = torch.maximum(kp * inertia - load.inertia.mean(dim=(0, 1)), smallest**3 * kp)
        model.raw_armature.copy_((armature / model.nominal_armature).log())
        friction.raw_coulomb.copy_((kp * dry / friction.nominal).clamp(min=smallest).log())
        # The parameters are logarithms of friction constants, divided by the initial values of `FrictionLaws`. Logs of
        # positions determine only the sum of kd and viscous friction, both its linear and its saturating part. The sum
        # is fitted as kd, and both parts are set to exp(-6) times their initial values, which is negligible. The fit of
        # the Stribeck effect starts at exp(-2) times its initial value.
        friction.raw_viscous.fill_(-6.0)
        friction.raw_saturation.fill_(-6.0)
        friction.raw_stribeck.fill_(-2.0)
        at_rest = (torque_error - load.gravity / kp).mean(dim=(0, 1))
        offset = torch.where(moving, offset, at_rest)
        model.raw_offset.copy_((kp * offset / friction.nominal).clamp(-2.0, 2.0))
        # A servo may be saturated for a moment, but not most of the time: it would not follow its command.
        torque = (kp * torque_error).abs().flatten(0, 1).quantile(TUNING.limit_quantile, dim=0)
        wrong = torque > servo.limit
        pairs = zip(model.joints, torque.tolist(), servo.limit.tolist(), wrong.tolist(), strict=True)
        limits = [f"{x.name!r} ({y:.3g}, limit {z:.3g})" for x, y, z, is_wrong in pairs if is_wrong]
        servo.limit.masked_fill_(wrong, torch.inf)
    message = "servos need torques [Nm, N] beyond the URDF's effort limits, which are not used"
    where = f"joint {', '.join(limits)}"
    return [Diagnostic("warning", "beyond-effort-limit", where, None, message)] if limits else []


def complete_joints_at_rest(model: ArmModel, moving: Tensor) -> None:
    """Set kd / kp, armature / kp and Coulomb friction / kp of joints at rest to the medians of the moving joints.

    The logs do not determine the servos of joints at rest. moving: (n,), False for joints at rest.
    """
    servo, friction = model.servo, model.friction
    with torch.no_grad():
        kp, coulomb = servo.kp(), friction.prepare().coulomb
        for raw, values in (
            (servo.raw_kd, servo.kd()),
            (model.raw_armature, model.armature),
            (friction.raw_coulomb, coulomb),
        ):
            ratios = values / kp
            if moving.any():
                raw.add_((ratios[moving].median() / ratios).log().masked_fill(moving, 0.0))


def _regression(columns: Tensor, errors: Tensor) -> tuple[Tensor, Tensor]:
    """Return the least-squares coefficients of each joint, and their t values, (n, 5) each.

    A t value is a coefficient divided by its standard deviation. The errors within a window are correlated: the K
    samples of a window count as one independent error.

    Args:
        columns: (W, K, n, 5), regressors of each joint at K samples of each of W windows: velocity, acceleration, dry
            friction divided by its magnitude (-1 to 1), torque of the bodies except for the inertial torque of the
            joint's own acceleration (`BodyLoad.bias`), and 1.
        errors: (W, K, n), command errors u - q [rad, m] at the same samples.
    """
    matrix = columns.flatten(0, 1).transpose(0, 1)  # (n, W K, 5): per joint, 5 regressors at W K samples
    target = errors.flatten(0, 1).mT.unsqueeze(-1)
    # The least-squares driver is gelsd, because torch's default driver chooses its pivots differently in each run.
    solution = torch.linalg.lstsq(matrix, target, driver="gelsd").solution
    residual = target - matrix @ solution
    unscaled = torch.linalg.pinv(matrix.mT @ matrix).diagonal(dim1=-2, dim2=-1)
    variance = residual.square().mean(dim=1) * unscaled * errors.shape[1]
    coefficients = solution.squeeze(-1)
    return coefficients, coefficients / variance.clamp(min=1e-300).sqrt()


def fit_linear_servos(windows: ServoWindows) -> LinearServos:
    """Return the parameters of both baselines: linear second-order servos, and a pure delay of the commands.

    The servo of each joint is fitted separately, to the samples after the burn-in. The baseline `DelayedCommand`
    predicts the delayed command as the position; its delay is common to all joints and is fitted to all samples.
    """
    q, qd = windows.q.numpy(), windows.qd.numpy()
    measured, dt = q[:, 1:], float(windows.dt.mean())

    # The commands, averaged over each interval, are cached per delay: most evaluations of the residual have the same
    # delay, since finite differences change one of the four unknowns x at a time.
    @lru_cache(maxsize=8)
    def commands(delay: float) -> np.ndarray:
        """Return the mean command of each interval of W windows of K samples, (W, K-1, n) [rad, m].

        delay: delay of the commands [s].
        """
        return windows.commands(delay).mean(dim=2).numpy()

    def delayed_error(delay: float) -> float:
        return float(np.square(commands(delay) - measured).mean())

    # A bounded scalar search suffices for the delay: within `max_delay`, 0.4 s, commands change so little that the
    # error, as a function of the delay, has one minimum.
    late = minimize_scalar(delayed_error, bounds=(0, TUNING.max_delay), method="bounded").x
    # The unknowns x of a joint's linear servo: log of the natural frequency [rad/s], log of the damping ratio, delay
    # [s], offset [rad, m].
    initial = (np.log(TUNING.frequency), 0.0, TUNING.initial_delay, 0.0)
    bounds = ((-np.inf, -np.inf, 0.0, -np.inf), (np.inf, np.inf, TUNING.max_delay, np.inf))
    fits = []
    for joint in range(q.shape[2]):
        column = slice(joint, joint + 1)

        def residual(x: np.ndarray, column: slice = column) -> np.ndarray:
            """Return the position errors [rad, m] of one joint after the burn-in, as a vector over all windows.

            x: (4,) log frequency, log damping ratio, delay and offset of the joint's servo. column: slice of the joint.
            """
            u = commands(x[2])[..., column] + x[3]
            frequency, damping = np.exp(x[:2].clip(-TUNING.max_logarithm, TUNING.max_logarithm))[:, None]
            predicted = linear_response(q[:, 0, column], qd[:, 0, column], u, dt, frequency, damping)
            result: np.ndarray = (predicted - measured[..., column])[:, windows.burn_in :].ravel()
            return result

        fits.append(least_squares(residual, initial, bounds=bounds, x_scale="jac", max_nfev=30).x)
    columns = np.array(fits).T
    columns[:2] = np.exp(columns[:2].clip(-TUNING.max_logarithm, TUNING.max_logarithm))
    frequency, damping, delay, offset = columns.tolist()
    return LinearServos(frequency, damping, delay, offset, float(late))
