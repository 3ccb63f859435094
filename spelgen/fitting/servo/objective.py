"""The objective servo: fit position servos, friction and weight of an arm to what follows its commands.

First least squares on the command error (`start`), then predicted windows (`problem`), in rounds: each takes the
bodies' load along what has been predicted, and the scale of errors, anew. After the first, joints get the dead zones
that they turn out to have (`laws`); the last has all windows.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch

from spelgen.dynamics.bristles import encoder_step
from spelgen.errors import Diagnostic
from spelgen.fitting.dataset import digest
from spelgen.fitting.levenberg_marquardt import TUNING as DAMPING
from spelgen.fitting.levenberg_marquardt import SolverState, initial_state, levenberg_marquardt
from spelgen.fitting.objective import FitRequest, Objective, PreparedLogs, Status
from spelgen.fitting.run_record import Content
from spelgen.fitting.servo.laws import select_dead_zones, without_faint
from spelgen.fitting.servo.linear_servos import fit_linear_servos
from spelgen.fitting.servo.parameters import ServoParameters
from spelgen.fitting.servo.problem import ServoProblem
from spelgen.fitting.servo.report import servo_record, solution
from spelgen.fitting.servo.start import start_servos
from spelgen.fitting.servo.tuning import ServoSolverTuning
from spelgen.fitting.servo.windows import servo_windows
from spelgen.logs.checks import check
from spelgen.logs.trajectory import require_commands, require_joints

if TYPE_CHECKING:
    from spelgen.fitting.progress import TrainingProgress

TUNING = ServoSolverTuning()
ROUNDS = 3  # on few windows with half the steps; on few, with dead zones; on all


class ServoObjective(Objective):
    """Fit all logs, so that none is left to validate on; each round can be gone on with.

    What a round computes with, the bodies' load and the scale of errors, comes of the parameters where it and the
    rounds before it began: these are all that a checkpoint keeps.
    """

    name: ClassVar[str] = "servo"
    input: ClassVar[Literal["torque", "position"]] = "position"

    def __init__(self, request: FitRequest) -> None:
        super().__init__(request)
        self._rounds: list[ServoParameters] = []  # where they began
        self._steps = 0

    def prepare(self) -> PreparedLogs:
        """See `Objective`."""
        request, model = self.request, self.model
        self._logs = request.logs
        for log in self._logs:
            require_joints(log, model.joint_names)
            require_commands(log)
        notes = check(self._logs, model.joint_names, model.joint_types)
        self._windows = servo_windows(self._logs, request.preprocessing)
        return PreparedLogs(
            config=request.config,
            preprocessing=request.preprocessing,
            digest=digest(self._logs),
            training=[log.name for log in self._logs],
            validation=[],
            training_windows=len(self._windows.q),
            validation_windows=0,
            notes=notes,
        )

    def begin(self) -> list[Diagnostic]:
        """Start servos by least squares."""
        self._since = time.monotonic()
        start_servos(self.model, self._windows)
        self._set_up(copy.deepcopy(self.model.state_dict()))
        self._begin_round(self._problem.start)
        return []

    def resume(self, checkpoint: Content, history: list[Content]) -> None:
        """Go on from the beginning of the last round."""
        self._since = time.monotonic() - checkpoint["seconds"]
        state = checkpoint["servo"]
        self.model.load_state_dict(state["start"])
        self._set_up(state["start"])
        self._steps = state["steps"]
        for parameters in state["rounds"]:
            self._begin_round(ServoParameters(**parameters))

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """See `Objective`."""
        problem = self._problem
        while True:
            number = len(self._rounds)
            show = partial(_show_progress, progress, number)
            x, damping = self._rounds[-1], DAMPING.initial
            if number > 1:  # near the minimum from where the round before ended
                damping = TUNING.later_damping
            result = levenberg_marquardt(
                problem,
                initial_state(problem, x, damping, self._steps),
                max_steps=TUNING.steps if number < ROUNDS else TUNING.last_steps,
                min_decrease=TUNING.gain,
                min_relative_decrease=TUNING.relative_gain,
                callback=show,
            )
            show(result.state)
            x, self._steps = result.state.x, result.state.steps
            if number == ROUNDS:
                break
            # dead zones are chosen when gains are right: before, errors are those of the gains
            choose = select_dead_zones if number == 1 else without_faint
            x = choose(problem, x)
            self._begin_round(x)
            save()
        self._finish(x)
        save()
        return "finished"

    def _finish(self, x: ServoParameters) -> None:
        """Take half as long steps, from which errors of the integration are known, and report the result."""
        problem = self._problem
        problem.windows = replace(self._windows, steps=2 * self._windows.steps)
        problem.nudge = TUNING.last_nudge  # by shorter ones a joint that just slips looks known
        end, solved = solution(problem, x)
        problem.write(end)
        record = servo_record(problem, solved, end, self._steps)
        linear = fit_linear_servos(self._windows.thinned(TUNING.sparse_windows))
        self.results["servo"] = record | {"linear": asdict(linear)}
        self._take_checkpoint(float(np.sqrt(np.square(record["rms"]).mean())))

    def _set_up(self, start: Content) -> None:
        """Take the model as it is, with these weights, for where the fit starts."""
        self._start = start
        steps = np.max([encoder_step(log.q) for log in self._logs], axis=0)
        # the standard deviation of an encoder's rounding, at the least of a hundredth of a milliradian
        noise = torch.from_numpy(steps).clamp(min=1e-5) / 12**0.5
        self._problem = ServoProblem(self.model, self._windows.thinned(TUNING.sparse_windows), noise)

    def _begin_round(self, x: ServoParameters) -> None:
        problem = self._problem
        if len(self._rounds) == ROUNDS - 1:
            problem.windows = self._windows
            problem.linearise(x, problem.windows.path())
        elif self._rounds:  # the first was near enough with errors of the integration
            problem.windows = replace(problem.windows, steps=self._windows.steps)
        if self._rounds:
            problem.linearise(x, problem.predicted_path(x))
        errors = problem.residual(x)
        problem.weigh(errors)
        problem.write(x)  # for the checkpoint: an interrupted fit is usable
        self._rounds.append(x)
        self._first_steps = self._steps
        self._take_checkpoint(float(errors.square().mean().sqrt()))

    def _take_checkpoint(self, rms: float) -> None:
        self._checkpoint = {
            "epoch": 0,
            "step": self._steps,
            "best_epoch": 0,
            "best_loss": rms,
            "best_weights": copy.deepcopy(self.model.state_dict()),
            "seconds": time.monotonic() - self._since,
            "substeps": self._windows.steps,
            "servo": {
                "start": self._start,
                "rounds": [vars(x) for x in self._rounds],
                "steps": self._first_steps,
            },
        }


def _show_progress(progress: TrainingProgress, number: int, state: SolverState[ServoParameters]) -> None:
    rms = float(state.residual.square().mean().sqrt())
    progress.round(number, ROUNDS, state.steps, rms)
