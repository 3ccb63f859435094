"""The model that is evaluated, with its fit and its arm if known."""

import copy
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from spelgen.arm.configured_arm import Arm, urdf_path
from spelgen.baselines.registry import FittedBaselines, LinearServoRecord
from spelgen.dynamics.bristles import BristleReach, bristle_reach, reach_of
from spelgen.emission.assemble import ArmModel, spec_of
from spelgen.emission.specify import arm_of_spec
from spelgen.evaluation.results import Results
from spelgen.evaluation.tuning import TUNING
from spelgen.evaluation.verdict import verdict
from spelgen.fitting.fitted import Fit, load_run
from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.arm_mapping import GivenMapping
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import OnWindows
from spelgen.settings.settings import load_mapping
from spelgen.spec import ModelSpec
from spelgen.urdf.read import read_urdf


@dataclass(frozen=True)
class Subject:
    """The evaluated model, with data about its fit; the defaults are for a model without a fit.

    urdf: URDF of the robot; None if unknown. preprocessing: preprocessing of the fit. window: number of samples of the
    training windows; a typical number for a model that was not fitted to windows. trained_on: names of the training and
    validation logs. baselines: baselines that were fitted to these logs. fitted_urdf: URDF for which the baselines were
    fitted. linear_servos: parameters of the linear servos that were fitted to these logs.
    """

    model: ArmModel
    urdf: Path | None
    preprocessing: Preprocessing | None = None
    window: int = TUNING.model_window
    trained_on: frozenset[str] = frozenset()
    baselines: FittedBaselines = field(default_factory=dict)
    fitted_urdf: Path | None = None
    linear_servos: LinearServoRecord | None = None

    @property
    def spec(self) -> ModelSpec | None:
        """Specification of the model; None for a model that was not built from a URDF."""
        return spec_of(self.model)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the URDF and in logs."""
        return tuple(self.model.joint_names)

    @property
    def reach(self) -> BristleReach:
        """Break-away displacements (n, K) [rad, m] of friction bristles; typical ones if the model has no bristles."""
        reach = bristle_reach(self.model)
        # Without bristles in the model, z is still needed for the baseline of least squares with bristles.
        return reach if reach.elements else reach_of(self.model.joint_types)

    @property
    def fitted_arm(self) -> Arm | None:
        """Arm for which the baselines of the fit were fitted. Raises UrdfError, ArmError or SettingsError."""
        if self.fitted_urdf is None or not self.baselines:
            return None
        return arm_of_spec(self.spec, self.fitted_urdf)

    def assessed(self, results: Results) -> Results:
        """Return the results of the evaluation of this model, with the assessment added."""
        limits, independent = [], []
        if self.spec is not None:
            depends = {*self.spec.potential, *(k for entry in self.spec.entries for k in entry[3])}
            for k, joint in enumerate(self.spec.joints):
                # A joint with only one limit has no range.
                bound = None if joint.lower is None or joint.upper is None else (joint.lower, joint.upper)
                limits.append(bound)
                if k not in depends:
                    independent.append(joint.name)
        return replace(results, assessment=verdict(results, self.baselines, limits, independent))


def subject(tested: ArmModel | Fit | Path | str, arm: Arm | Path | str | None = None) -> Subject:
    """Return the subject of an evaluation.

    tested: a model, a fit or the folder of a run. arm: arm, or path of its URDF; None: the arm of the fit.
    """
    fit = load_run(tested) if isinstance(tested, str | Path) else tested
    model = fit.model if isinstance(fit, Fit) else fit
    # Logs are read as float64 on the CPU, so the model must have the same type and device.
    if any(weights.dtype != torch.float64 or not weights.is_cpu for weights in model.parameters()):
        model = copy.deepcopy(model).double().cpu()
    if not isinstance(fit, Fit):
        return Subject(model, urdf_path(arm))
    record = fit.record
    return Subject(
        model,
        urdf_path(arm) or fit.urdf,
        preprocessing=fit.preprocessing,
        window=fit.config.window if isinstance(fit.config, OnWindows) else TUNING.model_window,
        trained_on=frozenset([*record.training, *record.validation]),
        baselines=fit.baselines,
        fitted_urdf=fit.urdf,
        linear_servos=record.servo and record.servo["linear"],
    )


def read_test_logs(
    folder: Path | str, paths: Iterable[Path | str], mapping: GivenMapping = None
) -> list[Trajectory]:
    """Return the test logs of a run's arm: the files test.* of a folder, or all files if none has this name.

    mapping: mapping of the log columns; None for the mapping of the training logs.
    """
    run = RunFolder(folder)
    record, spec = run.read_record(), run.read_spec()
    # By default the mapping of the training logs is used, since test logs usually come from the same logger.
    if mapping is None:
        mapping = record.mapping
    # The names in a mapping are checked against all joints of the URDF, not only the joints of the model: one mapping
    # may be used for several models of an arm.
    elif isinstance(mapping, str | Path) and run.urdf.exists():
        mapping = load_mapping(mapping, read_urdf(run.urdf).joint)
    return read_logs(paths, spec.joint_names, mapping, "test", joint_types=spec.joint_types)
