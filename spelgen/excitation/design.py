"""Design of exciting motions: the best of random motions, improved by L-BFGS."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isfinite

import numpy as np
import torch
from scipy.optimize import minimize

from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.errors import SettingsError
from spelgen.excitation.criterion import Criterion
from spelgen.excitation.excitation import Excitation
from spelgen.excitation.trajectory import ExcitationTrajectory, motion_bounds
from spelgen.excitation.tuning import TUNING


def excite(
    arm: ConfiguredArm,
    *,
    duration: float = 30.0,
    sample_rate: float = 100.0,
    harmonics: int | None = None,
    reach: float = 0.9,
    speed: float = 0.7,
    trials: int = 100,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Excitation:
    """Return an exciting motion, which starts and ends at rest; the same arguments give the same motion.

    The motion keeps effort limits too if the URDF has limits and inertials, and if any motion that was found keeps
    them. <mimic> joints keep their own limits. Collisions are not checked.

    Args:
        arm: configured arm.
        duration: of the motion, its period [s].
        sample_rate: approximate sample rate [Hz].
        harmonics: number of harmonics; default: 0.4 per second, at least 5.
        reach: fraction of the position ranges that is used.
        speed: fraction of the velocity limits that is used.
        trials: evaluations of the criterion by the optimizer, in addition to 40 random motions.
        seed: of the random motions.
        progress: is called with the numbers of finished and of all trials.

    Raises SettingsError for an invalid value, ArmError for a joint whose limits are not increasing.
    """
    positive = {"duration": duration, "sample_rate": sample_rate, "reach": reach, "speed": speed}
    for name, value in positive.items():
        is_fraction = name in ("reach", "speed")
        if not 0 < value < inf or (is_fraction and value > 1):
            expected = "more than 0, at most 1" if is_fraction else "a positive number"
            raise SettingsError(repr(value), element=f"excite: {name}", expected=expected)
    if harmonics is None:
        harmonics = max(TUNING.min_harmonics, round(TUNING.harmonics_per_second * duration))
    elif harmonics < 2:
        raise SettingsError(repr(harmonics), element="excite: harmonics", expected="2 or more")
    bounds = motion_bounds(arm.arm, reach, speed, arm.robot.joint)
    trajectory = ExcitationTrajectory(duration, harmonics, bounds)
    criterion = Criterion(arm.arm, trajectory)
    starts = np.random.default_rng(seed).standard_normal((TUNING.starts, trajectory.size))
    best = _improved(criterion, min(starts, key=criterion.value), trials, progress)
    motion = trajectory.motion(best, np.linspace(0.0, duration, round(duration * sample_rate) + 1))
    first, states = criterion.states(starts[0]), torch.from_numpy(np.stack([motion.q, motion.qd, motion.qdd]))
    return Excitation(
        arm=arm.arm,
        motion=motion,
        parameters=len(criterion.columns),
        first=criterion.condition(first),
        condition=criterion.condition(criterion.states(best)),
        efforts=np.abs(criterion.efforts(states)).max(axis=0),
        first_efforts=np.abs(criterion.efforts(first)).max(axis=0),
    )


def _improved(
    criterion: Criterion, initial: np.ndarray, trials: int, progress: Callable[[int, int], None]
) -> np.ndarray:
    """Return the best parameters (size,) of `trials` evaluations by L-BFGS, from initial parameters (size,).

    The criterion is not differentiable if singular values are equal, or if two samples have the largest speed. L-BFGS
    is efficient for such functions (Lewis and Overton, Math. Program. 141:135, 2013). Its last iterate need not be the
    best one, so all evaluations are compared.
    """
    best, lowest, done = initial, criterion.value(initial), 0
    if not isfinite(lowest):
        return initial

    def evaluate(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return criterion and gradient (size,), and keep the best parameters (size,)."""
        nonlocal best, lowest, done
        value, gradient = criterion.value_and_gradient(parameters)
        done += 1
        if value < lowest:
            best, lowest = parameters.copy(), value
        progress(min(done, trials), trials)
        return value, gradient

    options = {"maxfun": trials, "maxiter": trials, "maxcor": TUNING.history, "ftol": 0.0}
    minimize(evaluate, initial, jac=True, method="L-BFGS-B", options=options)
    return best
