"""The command `train`, which fits a module to log files and writes a run folder, and its options.

A value given by `--set KEY=VALUE` takes precedence over the value in the settings of the robot.
"""

from __future__ import annotations

import hashlib
import math
import textwrap
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from pydantic import ValidationError

from spelgen.cli import options
from spelgen.cli.console import INTERRUPTED, answer, note
from spelgen.cli.options import UsageError, argument, flag, option, output_option
from spelgen.errors import LogError, ModuleError, OptionError, RunError, suggestion
from spelgen.labels import counted
from spelgen.settings.fits import OWNERS, Adaptation, Objective, Rollout, TorqueFit, WindowConfig
from spelgen.settings.training import OF_LOGS, TrainingSettings
from spelgen.settings.yaml_document import Count, explain

if TYPE_CHECKING:
    from spelgen.fitting.fit import FitOptions
    from spelgen.fitting.fitted import Fit
    from spelgen.live.payload import Payload
    from spelgen.settings.log_mapping import LogMapping
    from spelgen.spec import ModelSpec

TIME_LIMIT = "max_minutes"


def train(
    module: Path | None = argument(
        "MODULE.py", "Module of `spelgen build`; with --resume, a run folder.", default=None
    ),
    extra_logs: list[Path] | None = options.MORE_DATA,
    data: list[Path] | None = options.DATA,
    output: Path | None = output_option("RUN", "Run folder; default: runs/<module>."),
    robot: Path | None = options.ROBOT_OPTION,
    mapping: Path | None = options.MAPPING_FILE,
    resume: bool = flag("--resume", "Resume the run in the run folder."),
    force: bool = options.FORCE,
    source: Path | None = option("RUN", "Adapt the model of this run; replaces MODULE.", "--from"),
    objective: Objective | None = option(
        "", "Default: torque for rigid bodies; rollout, after momentum steps, for networks."
    ),
    assignments: list[str] | None = option(
        "KEY=VALUE", "Set an option of the fit, e.g. epochs=50; repeat it for more options.", "--set"
    ),
    accept: list[str] | None = options.ACCEPT,
    format: options.TextOrJson = options.TEXT_OR_JSON,
) -> None:
    """Fit a module to logs.

    Defaults come from `training` in the robot's settings; --set takes the same keys, which docs/cli_runs.md lists.
    A key that does not apply to the objective is an error.
    """
    start_time = time.monotonic()  # The limit `max_minutes` includes reading the logs.
    # Keys of --set are checked before any file is read, so that a misspelt key costs no time.
    values = read_assignments(assignments or [])
    if source is not None:
        if module is not None:
            # With --from there is no argument MODULE, so the first argument is also a log.
            extra_logs = [module, *(extra_logs or [])]
        objective = adaptation(objective, values)
    elif "adapt" in values:
        raise UsageError("--set adapt: belongs to --from")
    elif module is None:
        raise typer.BadParameter("name a module, or a run with --from", param_hint="'MODULE.py'")
    paths = options.logs(data, extra_logs)
    # With --resume the first argument may be the run folder, and `folder` is then this argument.
    folder = output or _default_folder(module, source, resume=resume)
    spec, recorded, found = _specification(module, folder if resume else source)
    # A resumed run uses the settings in its record, since the settings file of the robot may have changed.
    urdf = None if resume else robot or found
    from spelgen.emission.specify import arm_of_spec
    from spelgen.log_checks.check_logs import require_sound_logs

    # The arm is loaded to check the logs and the mapping. A mapping may name all joints of the URDF, also joints that
    # are not in the model.
    arm = None if urdf is None else arm_of_spec(spec, urdf)
    settings = TrainingSettings() if arm is None else arm.settings.training
    log_mapping = options.log_mapping(arm or spec.joint_names, mapping or recorded, accept)
    # Torch is imported after the checks above, so that their errors are reported without delay.
    from spelgen.fitting.fit import RunOptions
    from spelgen.fitting.train import train as train_files

    # The options device and threads are not recorded in the run, because they describe the machine and not the result.
    machine = {"progress": True} | selected(values, ("device", "threads", "progress"))
    run_options = RunOptions(**machine, resume=resume, force=force, mapping=log_mapping, began=start_time)
    config = fit_options(objective, values, None if resume else settings, warm_start=source is not None)
    try:
        fit = train_files(
            module,
            paths,
            folder,
            config,
            urdf=urdf,
            source=source,
            of_logs=settings.model_dump(include=OF_LOGS, exclude_unset=True) | selected(values, OF_LOGS),
            require=lambda logs: [] if arm is None else require_sound_logs(logs, arm, log_mapping),
            options=run_options,
        )
    # The default objective depends on the logs. Options that do not apply to it are therefore found in `train_files`,
    # which raises OptionError.
    except OptionError as error:
        option = "--objective" if error.element == "objective" else f"--set {error.element}"
        raise UsageError(f"{option}: {error.got}") from error
    if TIME_LIMIT in values and TIME_LIMIT not in type(fit.config).model_fields:
        note(f"info: {TIME_LIMIT} limits fits to windows; these logs are fitted by {fit.config.objective}")
    _report(fit, folder, format, _payload(fit, source))


def _payload(fit: Fit, source: Path | None) -> Payload | None:
    """Write the noise levels of the live estimator into the run folder; return the payload in the logs, or None.

    The noise levels of a new fit of rigid bodies to torques are estimated from its logs. A run that was adapted from
    the run in the folder `source` gets a copy of the noise levels of that run, if there are any. `source` is None for a
    new fit.

    The payload is estimated only for `adapt=load`, with these noise levels and the model of `source`; otherwise the
    result is None.
    """
    from spelgen.live.levels import cross_validated_levels
    from spelgen.live.noise import keep_levels, stored_levels
    from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

    if source is None:
        try:
            if isinstance(fit.config, TorqueFit) and isinstance(fit.model, RigidBodyDynamics):
                keep_levels(fit, cross_validated_levels(fit))
        except LogError as error:
            note(f"info: no estimator: {error}")
        return None
    from spelgen.fitting.fitted import load_run
    from spelgen.live.replay import carried_payload

    original = load_run(source)
    levels = stored_levels(original)
    # Runs of earlier versions and runs with too short logs have no noise levels, so no payload can be estimated.
    if levels is None:
        return None
    keep_levels(fit, levels)
    if not (isinstance(fit.config, TorqueFit) and fit.config.adapt == "load"):
        return None
    payload, changed = carried_payload(original, fit.logs)
    if changed:
        note(
            f"warning: the load changes in {', '.join(changed)}, and one load is fitted: use logs with one load each"
        )
    return payload


def _report(fit: Fit, folder: Path, format: str, payload: Payload | None) -> None:
    """Print the outcome of the fit; exit with 130 if it was interrupted. payload: payload in the logs, or None."""
    posterior = fit.posterior if fit.checkpoint.posterior else None
    record: dict[str, object] = {"run": str(folder), "status": fit.status, "objective": fit.config.objective}
    record |= {"steps": fit.checkpoint.step, "epochs": fit.epochs, "seconds": fit.checkpoint.seconds}
    # The loss of a diverged rollout is infinite. JSON has no infinity, so it is written as null.
    record["validation_loss"] = fit.best_validation if math.isfinite(fit.best_validation) else None
    record["torque_nmse"] = fit.torque_nmse
    record["posterior"] = None if posterior is None else posterior.to_dict()
    record["findings"] = [finding.to_dict() for finding in fit.diagnostics]
    outcome: list[str] = [*_outcome(fit)]
    if payload is not None:
        from spelgen.live.replay import payload_content, payload_sentence

        record["payload"] = payload_content(payload)
        outcome.append(textwrap.fill(f"in these logs: {payload_sentence(payload)}", 80))
    # For a servo fit only the first table of the posterior is printed: the second table, of drives, is in `outcome`.
    listings = () if posterior is None else posterior.listings[: 1 if fit.record.servo else None]
    outcome += [table.text() for table in listings]
    answer(format, record, *outcome, f"run folder: {folder}")
    # An interrupted fit has the exit code that shells use, so that scripts can distinguish it from a finished fit.
    if fit.status == "interrupted":
        note("the best model so far is in the run folder; resume it by --resume")
        raise typer.Exit(INTERRUPTED)


def _outcome(fit: Fit) -> tuple[str, str]:
    """Return two sentences for the terminal: the status of a fit with its reason, and the result of the fit."""
    config, result, reason = fit.config, fit.result, ""
    progress = fit.checkpoint
    if fit.status == "out of time" and isinstance(config, WindowConfig):
        reason = f": max_minutes={config.max_minutes or 0:g} is over"
    # Only fits with the rollout objective have epochs; the sentence with their number is made below. For all other
    # fits, the printed result is the summary of a fit of position servos, the number of steps if there are no
    # validation windows, and otherwise `fit.result` (torque nMSE or validation loss).
    if not isinstance(config, Rollout):
        from spelgen.fitting.servo.report import servo_summary

        summary = servo_summary(fit.record.servo)
        if summary is not None:
            result = summary.text
        elif not fit.record.validation_windows:
            result = f"{progress.step} steps were taken"
        return f"{fit.status}: {config.objective} fitted in {progress.seconds:.0f} s{reason}", result
    if fit.status == "stopped early":
        reason = f": no better validation loss since epoch {progress.best_epoch}"
    elif fit.status == "finished":
        reason = ": all epochs are run" if fit.epochs >= config.epochs else ": no way further down"
    end = f"{fit.status} after {counted(fit.epochs, 'epoch')}, {progress.step} steps, {progress.seconds:.0f} s{reason}"
    return end, f"best {result}, at epoch {progress.best_epoch}"


def _default_folder(module: Path | None, source: Path | None, *, resume: bool) -> Path:
    """Return the run folder of a command without -o: runs/NAME of the module, or runs/NAME_adapted of the run `source`.

    With --resume, `module` may be the run folder itself. Raises RunError if there is no run to resume.
    """
    if resume and module is not None and module.is_dir():
        return module
    name = f"{(source or Path()).resolve().name}_adapted" if module is None else module.stem
    folder = Path("runs") / name
    if resume and module is not None and not folder.is_dir():
        got = f"no run: {module} is no folder, and there is no {folder}, the default folder of this module"
        raise RunError(got, element="--resume", do="name the run folder, or pass it by -o")
    return folder


def _specification(module: Path | None, run: Path | None) -> tuple[ModelSpec, LogMapping | None, Path | None]:
    """Return the specification of the model, the recorded mapping of the logs, and the URDF if it is known.

    They are read from the run that is resumed or adapted. For a new fit, the specification is read from the module, the
    URDF is the file in the folder of the module, and there is no mapping.
    """
    from spelgen.emission.text import read_spec
    from spelgen.fitting.run_folder import RunFolder

    if run is None and module is not None:
        spec = read_spec(module)
        return spec, None, _unchanged_urdf(module, spec)
    folder = RunFolder(run or Path())
    record, urdf = folder.read_record(), folder.urdf
    return folder.read_spec(), record.mapping, urdf if urdf.exists() else None


def _unchanged_urdf(module: Path, spec: ModelSpec) -> Path | None:
    """Return the URDF in the folder of a module; None if the module was not built from this file."""
    from spelgen.emission.specify import find_urdf
    from spelgen.urdf.document import urdf_bytes

    try:
        path = find_urdf(module, spec.urdf)
    except ModuleError:
        return None
    # A changed URDF is not used, because its settings and limits may not apply to the model.
    is_same = hashlib.sha256(urdf_bytes(path)).hexdigest() == spec.urdf_sha256
    return path if is_same else None


class Assignments(TrainingSettings):
    """The keys of the option `--set`: the training settings of a robot, and options of a single fit.

    adapt: change to which a fitted model is adapted: "load" (a payload), "friction" (another day), or "unit" (another
    arm of the same type). device, threads: device and number of threads of torch. progress: whether a progress bar is
    shown.
    """

    adapt: Adaptation | None = None
    device: str = "cpu"
    threads: Count = 1
    progress: bool = True


def read_assignments(assignments: Sequence[str]) -> dict[str, object]:
    """Return {key: checked value} for texts `KEY=VALUE`.

    A key such as `prior.bodies` sets one field of a group. Raises a usage error for an invalid value and for an unknown
    key; the message suggests the most similar known key.
    """
    keys = Assignments.model_fields.keys() - {"objective"}  # --objective sets the objective: no key of --set.
    # All assignments of --set are collected before they are checked, since the fields of a group are checked together.
    texts: dict[str, str | dict[str, str]] = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        name, _, field = key.strip().replace("-", "_").partition(".")
        # A missing `=` in --set is reported before an unknown key, because the user may have typed a blank in place of
        # `=`.
        if not equals:
            raise UsageError(f"--set: got {assignment!r}, expected KEY=VALUE")
        if name not in keys:
            raise UsageError(f"--set: unknown key {name!r}; {suggestion(name, sorted(keys))}")
        if not field:
            texts[name] = text
            continue
        group = texts.setdefault(name, {})
        if isinstance(group, dict):
            group[field] = text
    try:
        checked = Assignments.model_validate(texts)
    except ValidationError as error:
        wrong = explain(error.errors(include_url=False)[0], None, Assignments)
        raise UsageError(f"--set {wrong}") from error
    values = dict(checked)
    return {name: values[name] for name in texts}


def selected(values: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """Return {key: value} for each of `keys` that is in `values`, the values of `--set`."""
    return {name: values[name] for name in keys if name in values}


def adaptation(objective: Objective | None, values: dict[str, Any]) -> Objective:
    """Return the objective of a fit that starts from a fitted model (`--from`), by default "torque".

    A fit to torques estimates only a group of parameters, `adapt`: the load, friction, or all parameters that differ
    between units of one arm. If `values`, the values of `--set`, have no `adapt`, it is set to "load".

    Raises UsageError if `adapt` is set with another objective.
    """
    objective = objective or "torque"
    if objective == "torque":
        values.setdefault("adapt", "load")
    elif "adapt" in values:
        raise UsageError(f"--set adapt: belongs to the objective torque, this fits {objective}")
    return objective


def fit_options(
    objective: str | None,
    values: Mapping[str, Any],
    defaults: TrainingSettings | None,
    *,
    warm_start: bool,
) -> FitOptions:
    """Return the options of a fit; the command line takes precedence over the robot's settings.

    Args:
        objective: value of `--objective`; None: the settings or the logs determine the objective.
        values: {key of `--set`: value}.
        defaults: the robot's settings; None for a resumed run, whose record has all options.
        warm_start: whether the fit starts from the parameters of an earlier run.
    """
    from spelgen.fitting.fit import FitOptions

    options = selected(values, OWNERS)
    if defaults is None:
        return FitOptions(objective, options)
    settings = dict(defaults.options)
    objective = objective or defaults.objective
    if warm_start and objective == "rollout":
        # In a warm start no torque fit precedes the rollout fit: a torque fit would discard the source run's
        # parameters.
        settings["torque_first"] = False
    if objective is None and TIME_LIMIT in options:
        # Without --objective, the objective is chosen later from the logs, and may be one without a time limit. An
        # entry of `options` that does not apply is an error, an entry of `settings` (default values) is ignored: the
        # time limit is therefore moved to `settings`.
        settings[TIME_LIMIT] = options.pop(TIME_LIMIT)
    return FitOptions(objective, options, settings)
