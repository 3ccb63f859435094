"""Fit position servos, friction and weight of an arm to logs of commanded positions: its most probable weights.

First least squares on the command error (`servo_start`), then predicted windows (`servo_descent`), in rounds: each
takes the bodies' load along what has been predicted, and the scale of errors, anew. Before the fine ones joints get the
laws that they turn out to have (`servo_laws`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from spelgen.dynamics.bristles import encoder_step
from spelgen.fitting.servo_descent import Descent, Normal, Reached
from spelgen.fitting.servo_laws import with_laws, without_faint
from spelgen.fitting.servo_problem import ServoProblem
from spelgen.fitting.servo_start import start_servos
from spelgen.fitting.servo_weights import DEAD_ZONE, Point
from spelgen.fitting.servo_windows import ServoWindows
from spelgen.logs.trajectory import Trajectory

ROUNDS = 5
FINE = 2  # rounds at the end with all steps between samples, the others with half of them
GAIN = (1.0, 0.05)  # of the cost, in rounds before the fine ones and in these: less ends a round
LEFT = 0.01  # of the cost, at least, where its second derivatives promise less
LONG_NUDGE = 1e-3  # of weights, for the last slopes: by shorter ones a joint that just slips looks known
DAMPING = (1e-2, 1e-5)  # to begin with, in the first round and in the others


@dataclass(frozen=True, eq=False)
class ServoSolution:
    """How a fit ended. rms: (n,) root mean square errors of positions over windows [rad, m]. names: of the rows of
    weights of joints, (p, n), which with directions of bodies and the delay are the k unknowns of `Point.flat`.
    normal: of windows there; precision: (k,) of the prior, of all dead zones too; halved: (k,) what half as long steps
    of the rollouts still changed at the end. qd, gravity: velocities and gravity's torques along the windows, (M, n).
    """

    names: tuple[tuple[str, int], ...]
    rms: torch.Tensor
    steps: int
    normal: Normal
    precision: torch.Tensor
    halved: torch.Tensor
    qd: torch.Tensor
    gravity: torch.Tensor


class ServoRounds:
    """The changing state of a fit; from `state` another one goes on and repeats the same numbers.

    What a round computes with, the bodies' load and the scale of errors, comes of the points where it and the rounds
    before it began: these are all that has to be kept.
    """

    def __init__(
        self,
        model: Any,
        windows: ServoWindows,
        logs: Sequence[Trajectory],
        state: dict[str, Any] | None = None,
    ) -> None:
        """state: of the fit that this one goes on with. Raises KeyError, ValueError, TypeError or RuntimeError where
        it is not one of this model.
        """
        self.model, self.windows, delay = model, windows, 1 / windows.rate
        if state is None:
            model.servo.delay.fill_(delay)
            start_servos(model, windows, ServoProblem(model, windows).load, delay)
        else:
            model.load_state_dict(state["start"])
        self._start = {name: x.clone() for name, x in model.state_dict().items()}
        finest = np.max([encoder_step(x.q) for x in logs], axis=0)
        self._noise = torch.from_numpy(finest).clamp(min=1e-5) / 12**0.5
        self.problem = ServoProblem(model, replace(windows, steps=-(-windows.steps // 2)))
        self.begun: list[Point] = []
        for each in [vars(self.problem.start)] if state is None else state["begun"]:
            self._begin(Point(**each))
        self.reached = Reached(self.begun[0], DAMPING[0])
        if state is not None:
            self.reached = replace(Reached(**state["reached"]), point=Point(**state["reached"]["point"]))
        self.problem.write(self.reached.point)

    def _begin(self, point: Point) -> None:
        """The next round, from here."""
        if len(self.begun) >= ROUNDS - FINE:
            self.problem.windows = self.windows
        if self.begun:
            self.problem.relinearise(point, self.problem.path(point))
        self.begun.append(point)

    def run(self) -> Iterator[ServoRounds]:
        """Itself after each step, when `state` is to be kept and the model has the weights so far."""
        while True:
            descent = Descent(self.problem, self._noise, self.problem.errors(self.begun[-1]))
            for reached in descent.steps(self.reached, GAIN[len(self.begun) > ROUNDS - FINE]):
                self.reached = reached
                self.problem.write(reached.point)
                yield self
            if len(self.begun) == ROUNDS:
                return
            point = self.reached.point
            if len(self.begun) == ROUNDS - FINE:
                point = with_laws(self.problem, self._noise, point)
            elif len(self.begun) > ROUNDS - FINE:
                point = without_faint(self.problem, point)
            self._begin(point)
            self.reached = Reached(point, DAMPING[1], self.reached.taken)

    def state(self) -> dict[str, Any]:
        """What another one needs to go on."""
        reached = vars(self.reached) | {"point": vars(self.reached.point)}
        return {"start": self._start, "begun": [vars(x) for x in self.begun], "reached": reached}

    def foreseen(self) -> ServoSolution:
        """What windows will tell, by the slopes of their errors before the fit, were these errors as small as its first
        step promises.
        """
        point = self.reached.point
        errors = self.problem.errors(point)
        descent = Descent(self.problem, self._noise, errors)
        normal = self._with_dead_zones(descent, point)
        target = normal.target.sum(dim=0)
        gain = -float(target @ descent.step(normal, point))
        left = max(1 - gain / descent.square(errors), LEFT)
        return self._solution(
            point, Normal(normal.matrix / left, normal.target), torch.zeros_like(point.flat)
        )

    def solution(self) -> ServoSolution:
        """Give the model the most probable weights, after all rounds."""
        problem, point = self.problem, self.reached.point
        descent = Descent(problem, self._noise, problem.errors(self.begun[-1]))
        problem.windows = replace(self.windows, steps=2 * self.windows.steps)
        halved = descent.step(descent.normal(point, problem.errors(point)), point)
        point = point.moved(halved)
        problem.write(point)
        problem.nudge = LONG_NUDGE
        return self._solution(point, self._with_dead_zones(descent, point), halved)

    def _with_dead_zones(self, descent: Descent, point: Point) -> Normal:
        """What windows tell, also of dead zones that no joint was given."""
        every = self.problem.weights.with_all(point, DEAD_ZONE)
        normal = descent.normal(every, self.problem.errors(every))
        self.problem.write(point)
        return normal

    def _solution(self, point: Point, normal: Normal, halved: torch.Tensor) -> ServoSolution:
        problem = self.problem
        return ServoSolution(
            names=tuple(problem.weights.names),
            rms=problem.errors(point).square().mean(dim=(0, 1)).sqrt(),
            steps=self.reached.taken,
            normal=normal,
            precision=problem.weights.precision(problem.weights.with_all(point, DEAD_ZONE)),
            halved=halved,
            qd=problem.along.qd.flatten(0, 1),
            gravity=problem.load.gravity.flatten(0, 1),
        )
