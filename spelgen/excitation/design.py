"""The motion whose base regressor is conditioned best, found by an evolution strategy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, inf, log, sqrt

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor, urdf_parameters
from spelgen.excitation.trajectory import Motion, Series, bounds
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.friction import FrictionModel

PER_HARMONIC = 12  # samples of a motion that is tried
STARTS = 40  # motions at random, of which the best is improved
OFFSPRING = 16
FIRST_STEP = 0.3
PENALTY = 20.0  # on the logarithm of the condition number, for each part of an effort limit that is overrun
EFFORT = 0.9  # of the effort limits: friction comes on top of what the URDF says


@dataclass(frozen=True, eq=False)
class Excitation:
    """A motion and what it is worth.

    parameters: base parameters, friction and rotors included. first, condition: condition number of their
    regressor (columns of length one) for the first motion at random, and for this one. efforts: largest
    torque by the URDF's inertials, as part of the limit, (n,); NaN where limit or inertials are not known.
    first_efforts: of the first motion.
    """

    motion: Motion
    parameters: int
    first: float
    condition: float
    efforts: np.ndarray
    first_efforts: np.ndarray


def design(
    arm: Arm,
    *,
    duration: float,
    rate: float,
    harmonics: int,
    reach: float,
    speed: float,
    trials: int,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, all: None,
) -> Excitation:
    """An exciting motion of this duration [s], sampled at about `rate` [Hz]; the same for the same arguments.

    It starts and ends at rest and keeps the part `reach` of the joints' ranges and `speed` of their velocity
    limits; effort limits too, where the URDF has them and inertials, and where any motion can. trials: motions
    looked at. progress: called with the trials done and all.
    """
    series = Series(duration, harmonics, bounds(arm, reach, speed))
    judge = _Judge(arm, series)
    random = np.random.default_rng(seed)
    starts = random.standard_normal((STARTS, series.size))
    best = min(starts, key=judge.cost)
    best = _evolve(judge.cost, best, max(0, trials - STARTS), random, progress)
    motion = series.motion(best, np.linspace(0.0, duration, round(duration * rate) + 1))
    begun, found = judge.tried(starts[0]), judge.tried(best)
    return Excitation(
        motion=motion,
        parameters=len(judge.columns),
        first=judge.condition(begun),
        condition=judge.condition(found),
        efforts=judge.efforts(motion),
        first_efforts=judge.efforts(begun),
    )


class _Judge:
    """Says how good a motion is; less is better."""

    def __init__(self, arm: Arm, series: Series) -> None:
        self.arm, self.series = arm, series
        self.friction = FrictionModel()
        self.columns = base_parameters(arm, self.friction).columns
        self.times = np.linspace(0.0, series.duration, PER_HARMONIC * series.harmonics + 1)
        self.parameters = urdf_parameters(arm)
        known = all(body.inertia for body in arm.bodies)
        self.limits = np.array([(known and c.effort) or np.nan for c in arm.coordinates])

    def tried(self, numbers: np.ndarray) -> Motion:
        return self.series.motion(numbers, self.times)

    def condition(self, motion: Motion) -> float:
        """Condition number of the base regressor, its columns of length one; infinite where one is zero."""
        rigid = regressor(self.arm, motion.q, motion.qd, motion.qdd)
        rows = np.concatenate([rigid, self.friction.columns(motion.qd, motion.qdd)], axis=2)
        columns = rows[:, :, self.columns].reshape(-1, len(self.columns))
        length = np.linalg.norm(columns, axis=0)
        if not length.all():
            return inf
        values = np.linalg.svd(columns / length, compute_uv=False)
        return float(values[0] / values[-1]) if values[-1] > 0 else inf

    def efforts(self, motion: Motion) -> np.ndarray:
        """Largest torque of the rigid bodies, as part of the limit, (n,); NaN where that is not known."""
        torque = regressor(self.arm, motion.q, motion.qd, motion.qdd) @ self.parameters
        return np.abs(torque).max(axis=0) / self.limits

    def cost(self, numbers: np.ndarray) -> float:
        """The logarithm of the condition number, what limits are overrun, and amplitudes given away.

        Columns of length one know no amplitude, but the noise of a torque sensor does.
        """
        motion = self.tried(numbers)
        over = np.nan_to_num(self.efforts(motion) - EFFORT).clip(min=0.0).sum()
        given_away = -np.log(self.series.parts(numbers)).sum()
        return log(self.condition(motion)) + PENALTY * float(over) + float(given_away)


def _evolve(
    cost: Callable[[np.ndarray], float],
    start: np.ndarray,
    trials: int,
    random: np.random.Generator,
    progress: Callable[[int, int], None],
) -> np.ndarray:
    """The best of so many trials around a start: the mean of the better half of all offspring moves on.

    The step size follows the length of the mean's path (Hansen and Ostermeier, Evol. Comput. 9:159, 2001).
    """
    size, parents = len(start), OFFSPRING // 2
    weights = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    effective = 1.0 / float((weights**2).sum())
    memory = (effective + 2) / (size + effective + 5)
    usual = sqrt(size) * (1 - 1 / (4 * size) + 1 / (21 * size**2))  # length of a step at random
    mean, step, path = start.copy(), FIRST_STEP, np.zeros(size)
    best, least = start, cost(start)
    for done in range(0, trials, OFFSPRING):
        moves = random.standard_normal((OFFSPRING, size))
        costs = np.array([cost(mean + step * move) for move in moves])
        order = np.argsort(costs, kind="stable")[:parents]
        if costs[order[0]] < least:
            best, least = mean + step * moves[order[0]], float(costs[order[0]])
        move = weights @ moves[order]
        path = (1 - memory) * path + sqrt(memory * (2 - memory) * effective) * move
        mean = mean + step * move
        step *= exp(memory / (1 + memory) * (float(np.linalg.norm(path)) / usual - 1))
        progress(min(done + OFFSPRING, trials), trials)
    return best
