"""Evaluate a model and its baselines on test logs, on the same windows and with the same integrator.

``Subject`` combines the evaluated model with data about its fit and its arm.
"""

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spelgen.arm.configured_arm import Arm, urdf_path
from spelgen.baselines.predictor import Solver
from spelgen.baselines.registry import EvaluatedArm, FittedBaselines, command_followers, torque_predictors
from spelgen.dynamics.bristles import bristle_reach, reach_of
from spelgen.dynamics.parameters import used_parameter_count, without_idle_residuals
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.dynamics.tip import tip_kinematics
from spelgen.emission.assemble import ArmModel, spec_of
from spelgen.emission.specify import arm_of_spec
from spelgen.errors import Diagnostic, LogError, SpelgenError, in_one_line
from spelgen.evaluation.horizons import EvaluatedLogs, Horizon, TipPosition, horizon_lengths, predict
from spelgen.evaluation.replay import replays
from spelgen.evaluation.results import Results
from spelgen.evaluation.rollout import mass_errors
from spelgen.evaluation.torque import coarse_torques, torque_errors
from spelgen.evaluation.traces import Traces, motion_traces, replay_traces
from spelgen.evaluation.tuning import TUNING
from spelgen.evaluation.verdict import SEEN, Limits, verdict
from spelgen.fitting.fitted import Fit, load_run
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import MODEL
from spelgen.logs.arm_mapping import GivenMapping
from spelgen.logs.checks import check, joint_kinds
from spelgen.logs.dynamics_samples import NEEDED, dynamics_samples
from spelgen.logs.fingerprints import Fingerprints
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory, joined_column, recordings, require_commands, require_torques
from spelgen.settings.settings import load_mapping
from spelgen.urdf.read import read_urdf

STEPS: Sequence[int] = (1, 10)
SECONDS: Sequence[float] = (1.0,)
Progress = Callable[[int, int, str], None]


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
        self.linear_servos: Mapping[str, Any] | None = None
        if isinstance(fit, Fit):
            self.urdf, self.fitted_urdf = self.urdf or fit.urdf, fit.urdf
            self.preprocessing, self.baselines = fit.preprocessing, fit.baselines
            for name, fingerprint in fit.record.fingerprints.items():
                self.trained_on.add(name, fingerprint)
            self.linear_servos = fit.record.servo and fit.record.servo["linear"]

    @property
    def fitted_arm(self) -> Arm | None:
        """Arm in the URDF of the fit, whose kinematics the baselines of least_squares.json use; None without them.

        Raises UrdfError, ArmError or SettingsError.
        """
        if self.fitted_urdf is None or not self.baselines:
            return None
        return arm_of_spec(self.spec, self.fitted_urdf)

    def assessed(self, results: Results) -> Results:
        """Return the results of an evaluation of this model, with an added assessment in words.

        Its recommendations of further motions depend on the motion in the training logs and on the joint limits.
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
    # may be used for several models of an arm. The file need not state that the logs have commanded positions.
    elif isinstance(mapping, str | Path) and run.urdf.exists():
        mapping = load_mapping(mapping, read_urdf(run.urdf).joint)
        mapping = mapping.model_copy(update={"input": record.mapping.input})
    return read_logs(paths, spec.joint_names, mapping, "test", joint_types=spec.joint_types)


def evaluate(
    model: ArmModel | Fit | Path | str,
    logs: Trajectory | Sequence[Trajectory],
    *,
    arm: Arm | Path | str | None = None,
    baselines: Mapping[str, RigidDynamics] | None = None,
    preprocessing: Preprocessing | None = None,
    steps: Sequence[int] = STEPS,
    seconds: Sequence[float] = SECONDS,
    truth: Arm | Path | str | None = None,
    progress: Progress | None = None,
) -> Results:
    """Predict the states and torques of test logs, and return the errors of the model and of its baselines.

    Motion is predicted open loop, and again with a constant disturbance that a momentum observer estimates before each
    prediction starts (see `horizons.observe`). The result is deterministic, and no file is written.

    Args:
        model: an emitted model, a fit, or the folder of a run.
        logs: test logs of the same arm.
        arm: result of ``load_arm``, or the path of a URDF; by default the arm of the fit. It is needed for the URDF as
            a baseline, and for tip errors.
        baselines: dynamics by name, evaluated in addition to the baselines of `baselines.registry`, for example
            ``{"identified": identify(...).dynamics}``.
        preprocessing: filter and delay of states and torques; by default the preprocessing of the fit.
        steps: prediction horizons [samples].
        seconds: prediction horizons [s]. Horizons longer than every trajectory are omitted, with a note.
        truth: true arm of simulated logs, or the path of its URDF, with which the mass matrices of the model and of
            the baselines are compared.
        progress: function called before each horizon, with the number of finished horizons, the number of all
            horizons, and the name of the next horizon.

    Returns:
        Errors of the model and of all baselines, and the curves from which the errors are computed.

    Raises LogError.
    """
    # Model and logs are checked before the rollouts, because rollouts take minutes.
    tested = Subject(model, arm)
    logs = recordings(logs, tested.joints)
    notes = check(logs, tested.joints, joint_kinds(tested.model.joints))
    # Test logs that were also training logs are detected by fingerprints, because a run does not store the logs.
    seen = [x.name for x in logs if tested.trained_on.original(x.fingerprint)]
    if seen:
        message = (
            f"samples also used in training: {', '.join(seen)}; errors on training data are not test errors"
        )
        notes.append(Diagnostic("warning", SEEN, "logs", None, message))
    # Logs of position servos have no torques, so they are evaluated by replaying their commands.
    if tested.model.input_quantity == "position":
        if baselines:
            expected = "none: the model is one of position servos"
            raise LogError("baselines that take torques", expected=expected)
        for trajectory in logs:
            require_commands(trajectory)
        followers = command_followers(tested.linear_servos, notes)
        errors, missed = replays(tested.model, logs, followers)
        results = replace(_results(tested, logs, notes, replay_traces(missed)), replays=errors)
    else:
        require_torques(logs)
        used = _preprocessing(tested.preprocessing, preprocessing, logs)
        ahead = (steps, seconds)
        results = _evaluate_torques(tested, logs, notes, used, baselines or {}, ahead, truth, progress)
    return tested.assessed(results)


def _preprocessing(
    used: Preprocessing | None, chosen: Preprocessing | None, logs: Sequence[Trajectory]
) -> Preprocessing:
    """Return the preprocessing (filter, torque delay) of test logs: `chosen`, by default the preprocessing of the fit.

    used: preprocessing of the fit; None if the model has no fit. chosen: preprocessing that the user passed; None if
    the user passed none. Without both, default settings are used.
    """
    if chosen is None and used is not None:
        return used
    preprocessing = chosen or Preprocessing()
    # A given preprocessing without a torque delay gets the delay that the fit estimated: the delay is a property of the
    # logger and does not depend on the filter.
    if used is not None and preprocessing.torque_delay is None:
        preprocessing = replace(preprocessing, torque_delay=used.torque_delay)
    return preprocessing.resolved([trajectory.sample_rate for trajectory in logs])


def _evaluate_torques(
    tested: Subject,
    logs: Sequence[Trajectory],
    notes: list[Diagnostic],
    used: Preprocessing,
    baselines: Mapping[str, RigidDynamics],
    ahead: tuple[Sequence[int], Sequence[float]],
    truth: Arm | Path | str | None,
    progress: Progress | None,
) -> Results:
    """Return the errors of model and baselines on torque logs: of predicted torques, and of predicted motion.

    Args:
        tested: the model with the data of its fit.
        logs: test logs with torques.
        notes: list of remarks about the logs and the evaluation; further remarks are appended.
        used: preprocessing of the logs.
        baselines: {name: dynamics} of further baselines.
        ahead: prediction horizons, in samples and in seconds.
        truth: true arm of simulated logs, or the path of its URDF; None if unknown.
        progress: function called before each horizon, see `evaluate`.
    """
    # All errors are divided by the motion or by the variation of the torque. Logs at rest, whose errors would only show
    # noise, are therefore rejected.
    if max(float(np.ptp(trajectory.q, axis=0).max()) for trajectory in logs) < TUNING.smallest_motion:
        got = f"no motion: all joints stay within {TUNING.smallest_motion:g} rad or m"
        raise LogError(got, expected="test logs in which joints move")
    samples = dynamics_samples(logs, pauses=True, preprocessing=used, reach=tested.reach)
    samples = [sample for sample in samples if len(sample.q)]
    # A rollout needs at least two samples: the initial state and one prediction.
    pieces = used.pieces(logs, shortest=2)
    tests = EvaluatedLogs(pieces, samples, used, tested.reach, tested.model.joint_types)
    lengths = horizon_lengths(tests, *ahead, notes)
    # The windows for the choice of the integrator steps are short. In long windows, errors of the dynamics let the
    # motion diverge: integration errors cannot be distinguished from them.
    probe = tests.windows(TUNING.model_window - 1, TUNING.probed_model_windows)
    # Residual terms that the fit did not select are zero; they are removed to save time.
    model = without_idle_residuals(tested.model)
    # The number of integrator steps is chosen per predictor, because stiff friction needs more steps than smooth
    # dynamics. Integration errors are then negligible in the error of each predictor.
    arm = EvaluatedArm(tested.joints, tested.urdf, tested.baselines, tested.fitted_arm, probe, notes)
    predictors = {MODEL: Solver(model, probe)} | torque_predictors(arm)
    predictors |= {name: Solver(dynamics, probe) for name, dynamics in baselines.items()}
    tip = _tip(tested, notes) if lengths else None
    horizons: list[Horizon] = []
    longest = None
    for name, k in lengths.items():
        if progress is not None:
            progress(len(horizons), len(lengths), f"predicting {name} ahead")
        horizon, predictions = predict(name, k, tests, predictors, tip, notes)
        horizons.append(horizon)
        # Curves are kept for the longest horizon only, since they contain all shorter horizons.
        if k == max(lengths.values()):
            longest = predictions
    all_dynamics = {name: x.dynamics for name, x in predictors.items() if isinstance(x, Solver)}
    torque = {}
    if samples:
        torque = {name: torque_errors(dynamics, samples) for name, dynamics in all_dynamics.items()}
    if not horizons and not torque:
        raise LogError(
            "no figure: no rollout is evaluated, and torques need accelerations, which these logs do not show",
            expected=NEEDED,
            do="omit --quick",
        )
    # Torque errors of joints with coarsely quantised torques are mostly quantisation errors: tables contain them, the
    # assessment in words omits them.
    steps = coarse_torques(logs, tested.joints, notes) if torque else {}
    masses = {}
    if truth is not None:
        masses = mass_errors(all_dynamics, truth, tested.joints, torch.from_numpy(joined_column(logs, "q")))
    return replace(
        _results(tested, logs, notes, motion_traces(all_dynamics, tests, longest)),
        cutoff=used.cutoff or None,
        horizons=tuple(horizons),
        torque=torque,
        torque_steps=steps,
        mass_errors=masses,
    )


def _results(
    tested: Subject, logs: Sequence[Trajectory], notes: Sequence[Diagnostic], traces: Traces
) -> Results:
    """Return results that contain the names of the arm, joints and logs, the notes and the curves, but no errors yet.

    The fields of errors are empty until `replace` sets them.
    """
    return Results(
        robot=tested.spec.robot if tested.spec else type(tested.model).__name__,
        joints=tested.joints,
        joint_types=tuple(tested.model.joint_types),
        trajectories=tuple(trajectory.name for trajectory in logs),
        parameters=used_parameter_count(tested.model),
        diagnostics=tuple(notes),
        traces=traces,
    )


def _tip(tested: Subject, notes: list[Diagnostic]) -> TipPosition | None:
    if tested.urdf is None:
        return None
    try:
        tip = tested.spec.options.tip if tested.spec else None
        return tip_kinematics(tested.urdf, tip, joints=tested.joints).position
    # The evaluation continues without tip errors if the URDF has an error.
    except (ValueError, SpelgenError) as error:
        message = f"no tip errors: {in_one_line(error)}"
        notes.append(Diagnostic("info", "no-tip", tested.urdf.name, None, message))
        return None
