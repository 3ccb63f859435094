"""Objective `servo`: fit an arm's position servos, friction and gravity load to commands and measured positions.

The initial guess is the least-squares solution for the command error (`least_squares`). Three outer iterations then
minimize the error of predicted windows (`problem`). At its start, each iteration fixes the scale of the errors, and the
load of the bodies. The load is computed along the measured motion in the first iteration, and along the predicted
motion in the others. Dead zones are selected after the first outer iteration (`laws`). The last outer iteration uses
all windows.
"""

import copy
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import ClassVar, Literal

import numpy as np
import torch

from spelgen.dynamics.bristles import encoder_step
from spelgen.errors import Diagnostic
from spelgen.fitting.dataset import FitRequest, PreparedLogs, digest
from spelgen.fitting.levenberg_marquardt import SolverState, levenberg_marquardt
from spelgen.fitting.objective import Objective, Status
from spelgen.fitting.process import TrainingProgress
from spelgen.fitting.run_record import Content
from spelgen.fitting.servo.laws import select_dead_zones, without_small_dead_zones
from spelgen.fitting.servo.least_squares import complete_joints_at_rest, fit_linear_servos, set_initial_guess
from spelgen.fitting.servo.parameters import ServoParameters
from spelgen.fitting.servo.posterior import posterior_content
from spelgen.fitting.servo.problem import ServoProblem
from spelgen.fitting.servo.report import servo_record, solution
from spelgen.fitting.servo.rollouts import ServoRollouts
from spelgen.fitting.servo.tuning import TUNING
from spelgen.fitting.servo.windows import servo_windows
from spelgen.fitting.tuning import TUNING as DAMPING
from spelgen.logs.checks import check, joint_kinds
from spelgen.logs.trajectory import require_commands, require_joints

# Number of outer iterations of a servo fit: the first uses few windows and half the integration steps, the second few
# windows and all integration steps, the third all windows.
OUTER_ITERATIONS = 3


class ServoObjective(Objective):
    """Objective of a servo fit. The fit uses all logs, without validation, and can be resumed at each outer iteration.

    A checkpoint contains the initial weights of the model, and the fitted parameters at the start of each outer
    iteration. The torque of the rigid bodies and the scale of the position errors are recomputed from these parameters.
    """

    name: ClassVar[str] = "servo"
    input: ClassVar[Literal["torque", "position"]] = "position"

    def __init__(self, request: FitRequest) -> None:
        super().__init__(request)
        self._iterates: list[ServoParameters] = []  # fitted parameters at the start of each outer iteration
        self._steps = 0

    def prepare(self) -> PreparedLogs:
        """Check the logs and cut them into windows. Raises LogError if a log has no commands or too few samples."""
        request, model = self.request, self.model
        self._logs = request.logs
        for log in self._logs:
            require_joints(log, model.joint_names)
            require_commands(log)
        notes = check(self._logs, model.joint_names, joint_kinds(model.joints))
        self._windows = servo_windows(self._logs, request.preprocessing)
        return PreparedLogs(
            preprocessing=request.preprocessing,
            digest=digest(self._logs),
            training_names=[log.name for log in self._logs],
            window_counts=(len(self._windows.q), 0),
            diagnostics=notes,
        )

    def begin(self) -> list[Diagnostic]:
        """Set the model to the initial guess, and prepare the first outer iteration; return warnings about limits."""
        self._since = time.monotonic()
        notes = set_initial_guess(self.model, self._windows)
        self._set_up(copy.deepcopy(self.model.state_dict()))
        self._begin_iteration(self._rollouts.parameters.prior_mean)
        return notes

    def resume(self, checkpoint: Content, history: list[Content]) -> None:
        """Resume an interrupted fit at the start of the outer iteration in which it was interrupted."""
        self._since = time.monotonic() - checkpoint["seconds"]
        state = checkpoint["servo"]
        self.model.load_state_dict(state["start"])
        self._set_up(state["start"])
        self._steps = state["steps"]
        for parameters in state["rounds"]:
            self._begin_iteration(ServoParameters(**parameters))

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """Run the remaining outer iterations; ``save``, which writes a checkpoint, is called after each of them."""
        while len(self._iterates) < OUTER_ITERATIONS:
            x = self._minimized(progress)
            # Dead zones are selected after the first iteration: before it, errors of the initial gains would dominate
            # the position errors.
            select = select_dead_zones if len(self._iterates) == 1 else without_small_dead_zones
            self._begin_iteration(select(self._problem, x))
            save()
        self._finish(self._minimized(progress))
        save()
        return "finished"

    def _minimized(self, progress: TrainingProgress) -> ServoParameters:
        """Minimize the cost of the current outer iteration by Levenberg-Marquardt; return the fitted parameters."""
        problem, number = self._problem, len(self._iterates)

        def show(state: SolverState[ServoParameters]) -> None:
            rms = float(state.residual.square().mean().sqrt())
            progress.round(number, OUTER_ITERATIONS, state.steps, rms)

        # The damping is smaller in the second and third outer iteration, which start near the minimum.
        damping = DAMPING.initial_damping if number == 1 else TUNING.later_damping
        x = self._iterates[-1]
        result = levenberg_marquardt(
            problem,
            SolverState(x, self._errors, problem.cost(x, self._errors), damping, self._steps),
            max_steps=TUNING.steps if number < OUTER_ITERATIONS else TUNING.last_steps,
            min_decrease=TUNING.min_decrease,
            min_relative_decrease=TUNING.min_relative_decrease,
            callback=show,
        )
        show(result.state)
        self._steps = result.state.steps
        return result.state.x

    def _finish(self, x: ServoParameters) -> None:
        """Take a last Gauss-Newton step from x, with twice as many integration steps as in the fit; store the results.

        The step corrects most of the integration error of x. The parameters after the step are written to the model
        and, with their intervals, to `results`; their covariance is written to the checkpoint.
        """
        problem = self._problem.refined(2 * self._windows.steps, TUNING.last_difference_step)
        end, solved = solution(problem, x)
        problem.parameters.write(end)
        complete_joints_at_rest(self.model, self._windows.moving)
        record = servo_record(problem, solved, end, self._steps)
        linear = fit_linear_servos(self._windows.subsampled(TUNING.sparse_windows))
        self.results["servo"] = record | {"linear": asdict(linear)}
        self._update_checkpoint(float(np.sqrt(np.square(record["rms"]).mean())))
        self._checkpoint["posterior"] = posterior_content(problem, solved)

    def _set_up(self, weights: Content) -> None:
        """Create the rollouts of the first outer iteration. weights: initial state_dict, which is the prior mean."""
        self._initial_weights = weights
        steps = np.max([encoder_step(log.q) for log in self._logs], axis=0)
        # The standard deviation of the rounding error of an encoder is step / sqrt(12). The step is at least 1e-5 rad.
        # The error of a joint at rest has no weight: its servo keeps the initial guess. Otherwise friction that
        # prevents any motion would explain such a joint best.
        noise = torch.from_numpy(steps).clamp(min=1e-5) / 12**0.5
        self._noise = noise.masked_fill(~self._windows.moving, torch.inf)
        self._rollouts = ServoRollouts.of(self.model, self._windows.subsampled(TUNING.sparse_windows))

    def _begin_iteration(self, x: ServoParameters) -> None:
        """Begin an outer iteration at parameters x: recompute the load and the likelihood."""
        rollouts = self._rollouts
        if len(self._iterates) == OUTER_ITERATIONS - 1:
            rollouts = replace(rollouts, windows=self._windows)
            rollouts = rollouts.linearized(x, self._windows.motion())
        # The first outer iteration needs less accuracy and uses half the integration steps; the others use all of them.
        elif self._iterates:
            rollouts = replace(rollouts, windows=replace(rollouts.windows, steps=self._windows.steps))
        if self._iterates:
            rollouts = rollouts.linearized(x, rollouts.predicted_motion(x))
        self._errors = rollouts.residual(x)
        self._rollouts, self._problem = rollouts, ServoProblem.of(rollouts, self._noise, self._errors)
        # The model's weights are set to x, since the checkpoint contains them: an interrupted fit then has a usable
        # model.
        rollouts.parameters.write(x)
        self._iterates.append(x)
        self._first_steps = self._steps
        self._update_checkpoint(float(self._errors.square().mean().sqrt()))

    def _update_checkpoint(self, rms: float) -> None:
        """Set the checkpoint, in memory, that ``save`` writes. rms: RMS position error of all joints [rad, m]."""
        self._make_checkpoint(rms, time.monotonic() - self._since, self._windows.steps, self._steps)
        self._checkpoint["servo"] = {
            "start": self._initial_weights,
            "rounds": [vars(x) for x in self._iterates],
            "steps": self._first_steps,
        }
