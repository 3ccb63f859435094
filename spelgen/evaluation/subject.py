"""The model that an evaluation tests, with data about the fit and the arm of this model, and reading of test logs."""

import copy
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import torch

from spelgen.arm.configured_arm import Arm, urdf_path
from spelgen.baselines.fit import FittedBaselines
from spelgen.baselines.registry import LinearServoRecord
from spelgen.dynamics.bristles import bristle_reach, reach_of
from spelgen.emission.assemble import ArmModel, spec_of
from spelgen.emission.specify import arm_of_spec
from spelgen.evaluation.results import Results
from spelgen.evaluation.verdict import Limits, verdict
from spelgen.fitting.fitted import Fit, load_run
from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.arm_mapping import GivenMapping
from spelgen.logs.fingerprints import Fingerprints
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.settings import load_mapping
from spelgen.urdf.read import read_urdf


class Subject:
    """The evaluated model, with data about its fit; for a model without a fit, these data are None or empty.

    Attributes:
        model: The evaluated model.
        spec: Specification of the model; None for a model that was not built from a URDF.
        joints: Names of the joints in the URDF and in logs.
        reach: Break-away displacements of the K friction bristles of each joint, (n, K) [rad, m].
        urdf: URDF of the robot; None if unknown.
        preprocessing: Filter and delay that the fit used.
        trained_on: Fingerprints of the training and validation logs.
        baselines: Content of least_squares.json: baselines that were fitted to the training logs.
        fitted_urdf: URDF of the fit, whose kinematics the baselines use.
        linear_servos: Parameters of the linear servos that were fitted to the training logs.
    """

    def __init__(self, tested: ArmModel | Fit | Path | str, arm: Arm | Path | str | None) -> None:
        """Collect the evaluated model and the data of its fit from a model, a fit or the folder of a run.

        arm: arm, or path of its URDF; None: the arm of the fit.
        """
        fit = load_run(tested) if isinstance(tested, str | Path) else tested
        self.model = fit.model if isinstance(fit, Fit) else fit
        # Logs are read as float64 on the CPU, so the model must have the same type and device.
        if any(weights.dtype != torch.float64 or not weights.is_cpu for weights in self.model.parameters()):
            self.model = copy.deepcopy(self.model).double().cpu()
        self.spec = spec_of(self.model)
        self.joints = tuple(self.model.joint_names)
        reach = bristle_reach(self.model)
        # If the model has no bristles, default break-away displacements are used: the baseline of least squares may
        # have bristles.
        self.reach = reach if reach.elements else reach_of(self.model.joint_types)
        self.urdf = urdf_path(arm)
        self.fitted_urdf: Path | None = None
        self.preprocessing: Preprocessing | None = None
        self.trained_on = Fingerprints()
        self.baselines: FittedBaselines = {}
        self.linear_servos: LinearServoRecord | None = None
        if isinstance(fit, Fit):
            self.urdf, self.fitted_urdf = self.urdf or fit.urdf, fit.urdf
            self.preprocessing, self.baselines = fit.preprocessing, fit.baselines
            for name, fingerprint in fit.record.fingerprints.items():
                self.trained_on.add(name, fingerprint)
            self.linear_servos = fit.record.servo and fit.record.servo["linear"]

    @property
    def fitted_arm(self) -> Arm | None:
        """Arm of the URDF of the fit, for the baselines that were fitted to the training logs; None without them.

        The baselines use its kinematics. Raises UrdfError, ArmError or SettingsError.
        """
        if self.fitted_urdf is None or not self.baselines:
            return None
        return arm_of_spec(self.spec, self.fitted_urdf)

    def assessed(self, results: Results) -> Results:
        """Return the results of an evaluation of this model with an assessment in words added.

        The assessment uses the range of the training logs and the joint limits of the specification.
        """
        limits: Limits = ()
        independent: list[str] = []
        if self.spec is not None:
            limits = [joint.limits for joint in self.spec.joints]
            depends = {*self.spec.potential, *(k for entry in self.spec.entries for k in entry[3])}
            independent = [name for k, name in enumerate(self.spec.joint_names) if k not in depends]
        return replace(results, assessment=verdict(results, self.baselines, limits, independent))


def read_test_logs(
    folder: Path | str, paths: Iterable[Path | str], mapping: GivenMapping = None
) -> list[Trajectory]:
    """Return the test logs of a run's arm.

    Args:
        folder: Run folder.
        paths: Log files, and folders with log files. If a folder contains files test.*, its other files are ignored.
        mapping: Mapping of the log columns; None: the mapping of the training logs.
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
