"""The objective momentum: steps on the weak form of the equations alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

from spelgen.errors import Diagnostic
from spelgen.fitting.objective import Status
from spelgen.fitting.run_record import Content
from spelgen.fitting.window.objective import TUNING, WindowObjective

if TYPE_CHECKING:
    from spelgen.fitting.progress import TrainingProgress


class MomentumObjective(WindowObjective):
    """Steps on the weak form, kept where they predict validation windows better."""

    name: ClassVar[str] = "momentum"

    def begin(self) -> list[Diagnostic]:
        """Measure the model as it is."""
        self._set_up()
        return self.notes

    def resume(self, checkpoint: Content, history: list[Content], record: Content) -> None:
        """Go on from the weights so far; steps that were not all taken start again."""
        self._set_up()
        self._restore(checkpoint)

    def run(self, progress: TrainingProgress, save: Callable[[], None]) -> Status:
        """See `Objective`."""
        status: Status = "finished"
        if not self.momentum_done:
            self._start_clock()
            self._momentum_stage(progress)
            if self.clock.fraction(self.seconds) >= TUNING.momentum_fraction:
                status = "out of time"
        save()
        return status
