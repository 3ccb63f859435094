"""The interface of a baseline: what a model of an arm has to beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from spelgen.baselines.predictor import Predictor
from spelgen.errors import Diagnostic
from spelgen.fitting.fitted import Fit
from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.commands import LogRows
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows


@dataclass(frozen=True)
class JudgedArm:
    """What baselines may know of an arm under torques that is judged.

    joints: their names, in the order of q. urdf, run: None where these are not known. probe: windows that say in which
    steps dynamics are to be integrated. notes: what a baseline has to say, such as why it is not there.
    """

    joints: Sequence[str]
    urdf: Path | None
    run: RunFolder | None
    probe: Windows
    notes: list[Diagnostic]


class CommandFollower(Protocol):
    """Predict the positions of an arm under commands. about: what it is, and how it was fitted."""

    @property
    def about(self) -> str: ...

    def positions(self, parts: Sequence[LogRows], q: np.ndarray, qd: np.ndarray) -> list[np.ndarray]:
        """Return positions (K, n) after each interval of each part of a log, from q and qd (parts, n)."""


class Baseline:
    """Predict an arm by simple means. It is listed once, in `registry.py`, and evaluation takes it from there.

    It predicts arms under torques, under commands, or both: one of the last two methods returns something.
    """

    def fit(self, run: RunFolder, logs: Sequence[Trajectory], files: Sequence[str]) -> dict[str, object]:
        """Return what is kept of a run's own training logs, as JSON; {} where there is nothing to fit.

        files: the paths of these logs; empty where some were in memory.
        """
        return {}

    def predictors(self, judged: JudgedArm) -> list[Predictor]:
        """Return what predicts under torques, none where something for it is missing."""
        return []

    def followers(self, fit: Fit | None, notes: list[Diagnostic]) -> dict[str, CommandFollower]:
        """Return by name what predicts under commands, beside a model that was fitted to them.

        fit: None for a model of which nothing else is known.
        """
        return {}
