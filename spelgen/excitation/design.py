"""Design the motion that shows an arm's parameters best: random starts, the best of them improved by L-BFGS."""

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
    """Return an exciting motion of this duration [s], sampled at about `sample_rate` [Hz]; same arguments, same motion.

    It starts and ends at rest and keeps the part `reach` of the joints' ranges and `speed` of their velocity
    limits; effort limits too, where the URDF has them and inertials, and where any motion can. Joints that follow
    others by <mimic> keep their limits as well. Collisions are not checked.
    harmonics: of the period `duration`; by default 0.4 a second, at least 5. trials: motions that the search looks
    at, beside 40 at random that it starts from. progress: called with the trials done and all.
    Raises SettingsError for a value that cannot be, ArmError for a joint without room between its limits.
    """
    positive = {"duration": duration, "sample_rate": sample_rate, "reach": reach, "speed": speed}
    for name, value in positive.items():
        is_fraction = name in ("reach", "speed")
        if not 0 < value < inf or (is_fraction and value > 1):
            expected = "more than 0, at most 1" if is_fraction else "a positive number"
            raise SettingsError(repr(value), element=f"excite: {name}", expected=expected)
    if harmonics is None:
        harmonics = max(TUNING.fewest_harmonics, round(TUNING.harmonics_per_second * duration))
    elif harmonics < 2:
        raise SettingsError(repr(harmonics), element="excite: harmonics", expected="2 or more")
    bounds = motion_bounds(arm.arm, reach, speed, arm.robot.joint, arm.settings.simulation.positions)
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
    criterion: Criterion, start: np.ndarray, trials: int, progress: Callable[[int, int], None]
) -> np.ndarray:
    """Return the best of so many trials from a start on.

    The criterion has kinks, where singular values meet and where another sample is the fastest: L-BFGS gets far on
    such functions (Lewis and Overton, Math. Program. 141:135, 2013), and what it saw counts, not where it ended.
    """
    best, lowest, done = start, criterion.value(start), 0
    if not isfinite(lowest):
        return start

    def evaluate(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best, lowest, done
        value, gradient = criterion.value_and_gradient(parameters)
        done += 1
        if value < lowest:
            best, lowest = parameters.copy(), value
        progress(min(done, trials), trials)
        return value, gradient

    options = {"maxfun": trials, "maxiter": trials, "maxcor": TUNING.memory, "ftol": 0.0}
    minimize(evaluate, start, jac=True, method="L-BFGS-B", options=options)
    return best
