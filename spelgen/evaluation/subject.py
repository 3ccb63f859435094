"""What is judged, and what is known of how it came about."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from spelgen.dynamics.bristles import BristleReach, bristle_reach, reach_of
from spelgen.evaluation.tuning import TUNING
from spelgen.fitting.fitted import Fit, load_run
from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.arm_mapping import GivenMapping
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.settings import load_mapping
from spelgen.spec import Facts, logged_joints, read_facts
from spelgen.urdf.read import read_urdf

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel
    from spelgen.pipeline.loaded_arm import LoadedArm


@dataclass(frozen=True)
class Subject:
    """A model with its joints as the URDF and logs name them; urdf: its robot's, fit: what found it, where known."""

    model: EmittedModel
    joints: Sequence[str]
    urdf: Path | None
    fit: Fit | None

    @property
    def facts(self) -> Facts | None:
        """What the module was built from; None of something that has an arm's dynamics in another way."""
        return getattr(self.model, "facts", None)

    @property
    def window(self) -> int:
        """Samples of the windows that it was fitted to."""
        return getattr(self.fit and self.fit.config, "window", TUNING.model_window)

    @property
    def reach(self) -> BristleReach:
        """Reach (n, K) of the bristles that friction remembers with, its own or the usual ones."""
        reach = bristle_reach(self.model)
        # friction without a state is judged beside least squares with one: z is found for that
        return reach if reach.elements else reach_of(self.model.joint_types)

    @property
    def trained_on(self) -> frozenset[str]:
        """Names of the trajectories that it has seen."""
        if self.fit is None:
            return frozenset()
        return frozenset([*self.fit.record["training"], *self.fit.record["validation"]])

    @property
    def run(self) -> RunFolder | None:
        """The folder of its fit, where there is one."""
        if self.fit is None or self.fit.folder is None:
            return None
        return RunFolder(self.fit.folder)


def subject(judged: EmittedModel | Fit | Path | str, arm: LoadedArm | Path | str | None = None) -> Subject:
    """Return what is judged: a model, a fit or the folder of a run, on an arm or the URDF of this path."""
    if isinstance(judged, str | Path):
        judged = load_run(judged)
    model, fit = (judged.model, judged) if isinstance(judged, Fit) else (judged, None)
    urdf = None if fit is None else fit.urdf
    if arm is not None:
        urdf = Path(arm) if isinstance(arm, str | Path) else arm.robot.path
    weights = next(model.parameters(), None)
    if weights is not None and (weights.dtype != torch.float64 or not weights.is_cpu):  # as logs are
        model = copy.deepcopy(model).double().cpu()
    return Subject(model, logged_joints(model), urdf, fit)


def read_test_logs(
    folder: Path | str, paths: Iterable[Path | str], mapping: GivenMapping = None
) -> list[Trajectory]:
    """Return logs of a run's arm (a folder's test.* where there are such), mapped as those that it was trained on."""
    run = RunFolder(folder)
    record, facts = run.read_config(), read_facts(run.module)
    if mapping is None:
        mapping = LogMapping(**record["mapping"])
    elif isinstance(mapping, str | Path) and run.urdf.exists():  # it may speak of all joints of the URDF
        mapping = load_mapping(mapping, read_urdf(run.urdf).joint)
    return read_logs(paths, facts.joints, mapping, "test", joint_types=facts.joint_types)
