"""The objective servo: fit an arm under position servos to its logs of commanded positions."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from spelgen.dynamics.protocol import has_servos
from spelgen.errors import Diagnostic, LogError, OptionError
from spelgen.fitting.dataset import digest
from spelgen.fitting.objective import FitRequest, PreparedLogs, Status
from spelgen.fitting.servo.linear_servos import fit_linear_servos
from spelgen.fitting.servo_fit import ROUNDS, ServoRounds
from spelgen.fitting.servo_report import foreseen, foreseen_text, servo_record
from spelgen.fitting.servo_windows import servo_windows
from spelgen.fitting.streaming import LargeLogs
from spelgen.logs.checks import check
from spelgen.logs.trajectory import Trajectory, require_commands, require_joints
from spelgen.settings.log_mapping import LogMapping

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel
    from spelgen.fitting.progress import TrainingProgress


class ServoObjective:
    """All logs are fitted, so that none is left to validate on; rounds of steps, each of which can be gone on with."""

    name: ClassVar[str] = "servo"

    def __init__(self, request: FitRequest) -> None:
        if not has_servos(request.model):
            raise OptionError("objective", "servo belongs to arms with 'input: position' in their settings")
        self.request = request
        self.history: list[dict[str, Any]] = []
        self._results: dict[str, object] = {}

    def prepare(self) -> PreparedLogs:
        """See `Objective`."""
        request = self.request
        self.logs = _commanded(request.model, request.logs)
        notes = check(self.logs, request.model.facts.joints, request.model.joint_types)
        self.windows = servo_windows(self.logs, request.preprocessing)
        return PreparedLogs(
            config=request.config,
            preprocessing=request.preprocessing,
            digest=digest(self.logs),
            training=tuple(x.name for x in self.logs),
            validation=(),
            training_windows=len(self.windows.q),
            validation_windows=0,
            mapping=request.mapping or LogMapping(input="position"),
            notes=tuple(notes),
        )

    def begin(self) -> list[Diagnostic]:
        """Start servos by least squares, and tell what the logs will determine."""
        model = self.request.model
        self._since = time.monotonic()
        self.rounds = ServoRounds(model, self.windows, self.logs)
        names = foreseen(model, self.rounds.foreseen())
        self._results = {"foreseen": names}
        self._checkpoint = self._state()
        return [Diagnostic("info", "identifiability", "logs", None, foreseen_text(model, names))]

    def resume(
        self, checkpoint: dict[str, Any], history: list[dict[str, Any]], record: dict[str, Any]
    ) -> None:
        """Go on from the last step."""
        self._since = time.monotonic() - checkpoint["seconds"]
        self.rounds = ServoRounds(self.request.model, self.windows, self.logs, checkpoint["servo"])
        self._results = {"foreseen": record.get("foreseen")}
        self._checkpoint = checkpoint

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """See `Objective`."""
        model, rounds = self.request.model, self.rounds
        for _ in rounds.run():
            self._checkpoint = self._state()
            save()
            progress.round(len(rounds.begun), ROUNDS, rounds.reached.taken, rounds.reached.rms)
        solution = rounds.solution()
        linear = fit_linear_servos(self.windows).to_dict()
        self._results["servo"] = servo_record(model, solution) | {"linear": linear}
        self._checkpoint = self._state() | {"best_loss": float(solution.rms.square().mean().sqrt())}
        save()
        return "finished"

    def checkpoint(self) -> dict[str, Any]:
        """Return that of the last whole step."""
        return self._checkpoint

    def results(self) -> dict[str, object]:
        """Return what the logs were to determine, and at the end what they did."""
        return self._results

    def _state(self) -> dict[str, Any]:
        weights = {name: x.clone() for name, x in self.request.model.state_dict().items()}
        return {
            "epoch": 0,
            "step": self.rounds.reached.taken,
            "best_epoch": 0,
            "best_loss": self.rounds.reached.rms,
            "best_weights": weights,
            "seconds": time.monotonic() - self._since,
            "substeps": self.rounds.windows.steps,
            "servo": self.rounds.state(),
        }


def _commanded(model: EmittedModel, logs: Sequence[Trajectory] | LargeLogs) -> Sequence[Trajectory]:
    """Return the logs, which hold commands. Raises LogError where they do not."""
    if isinstance(logs, LargeLogs):
        raise LogError(
            "logs of positions larger than memory", expected="some hours of them: every tenth file, say"
        )
    for log in logs:
        require_joints(log, model.facts.joints)
        require_commands(log)
    return logs
