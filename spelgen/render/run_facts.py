"""Facts about a run for its page: training, options, and commands that reproduce the run."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from spelgen.errors import shortened
from spelgen.evaluation.results import Results
from spelgen.fitting.fitted import Fit
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_record import Record
from spelgen.fitting.torque.report import terms_in_use
from spelgen.labels import MODEL, counted, share
from spelgen.listing import duration, number
from spelgen.logs.preprocessing import Preprocessing
from spelgen.render.charts import TUNING
from spelgen.runtime.residual_terms import ResidualDynamics
from spelgen.settings.fits import CONFIGS
from spelgen.settings.training import TrainingSettings
from spelgen.spec import ModelSpec, Options


def outlier_note(results: Results) -> str:
    """Return a sentence for the report if the RMS prediction error is far above the median error; else "".

    A few predictions with large errors then dominate the RMS.
    """
    growth = results.traces.growth
    if growth is None or MODEL not in growth.relative or not results.horizons:
        return ""
    last, median = results.horizons[-1], growth.relative[MODEL].median[-1]
    rms = last.errors[MODEL].mean_relative_rms
    if rms is None or not rms > TUNING.dominated * median:
        return ""
    text = f"After {last.name} the median error is {share(median, 'the motion')}, and the root mean square "
    return f"{text}{share(rms, 'the motion')}: few starts dominate it."


def training_facts(fit: Fit) -> dict[str, str]:
    """Return {label: text} about the logs, the preprocessing and the duration of a fit."""
    record, preprocessing = fit.record, fit.preprocessing
    facts = {
        "objective": record.objective,
        "training logs": _names(record.training),
        "validation logs": _names(record.validation),
        "filter": f"{preprocessing.cutoff:g} Hz, zero phase" if preprocessing.filtered else "none",
    }
    # Only fits to windows have a number of windows. A fit to torques uses single samples.
    if record.objective != "torque":
        facts["windows"] = (
            f"{record.training_windows:,} for training, {record.validation_windows:,} for validation"
        )
    if isinstance(fit.model, ResidualDynamics):
        facts["residual terms"] = "; ".join(terms_in_use(fit.model)) or "none selected"
    # Only fits with epochs have metrics; fits to torques have none.
    if fit.history:
        last = fit.history[-1]
        best = fit.checkpoint.best_epoch
        origin = f"epoch {best}" if best else "the start: no epoch was better"
        facts["length"] = f"{last['epoch']} epochs, {last['step']:,} steps, {duration(last['seconds'])}"
        facts["kept"] = f"the model of {origin}, validation loss {number(last['best'])}"
        if record.options.get("solver", "rk4") == "rk4":
            facts["integrator"] = f"rk4, {counted(last['substeps'], 'step')} between samples"
    for label, remarks in (("warnings", record.warnings), ("notes", record.notes)):
        if remarks:
            facts[label] = "; ".join(remarks)
    if record.options.get("momentum_steps"):
        facts["start"] = f"{record.options['momentum_steps']:,} steps on the momentum along the logs"
    return facts


def _names(trajectories: Sequence[str]) -> str:
    count = counted(len(trajectories), "trajectory")
    return f"{count}: {shortened(trajectories, 5)}" if trajectories else "none"


def commands(run: RunFolder, spec: ModelSpec, record: Record) -> list[str]:
    """Return the commands of a shell that reproduce a run, for its page.

    The run does not record the paths of its logs, so the commands contain the placeholder LOGS. spec: specification of
    the model. record: options and results of the training.
    """
    # Options of `spelgen build` with default values are omitted, to keep the command short.
    options = asdict(spec.options)
    # A design is a preset of the user, in a YAML file. The run folder has no copy of this file, so the printed command,
    # `spelgen build`, names it as `--preset NAME.yaml`.
    if spec.options.design is not None:
        options["preset"] += ".yaml"
    # The command names the URDF without its folder, as it may be a folder of another machine.
    robot, option = shlex.quote(Path(spec.urdf).name), ""
    if run.urdf.exists():
        robot, option = f"RUN/{run.urdf.name}", f" --robot RUN/{run.urdf.name}"
    build = f"spelgen build {robot}"
    for key, value in _changed(options, asdict(Options())).items():
        words = ",".join(value) if isinstance(value, (list, tuple)) else str(value)
        build += f" --{key.replace('_', '-')} {shlex.quote(words)}"
    objective = record.objective
    train = f"spelgen train module.py{option} --data LOGS -o RUN2 --objective {objective}"
    defaults = CONFIGS[objective]().model_dump(mode="json") | asdict(Preprocessing())
    defaults |= TrainingSettings().model_dump(include={"validation_fraction", "seed"})
    options = {"validation_fraction": record.validation_fraction, "seed": record.seed}
    options |= record.options | asdict(record.preprocessing)
    for key, value in _changed(options, defaults).items():
        train += f" --set {shlex.quote(f'{key}={value}')}"
    # If the run folder contains a mapping, the run used it in place of the mapping in the settings of the robot.
    if run.mapping.exists():
        train += f" --mapping RUN/{run.mapping.name}"
    return [f"{build} -o module.py", train, "spelgen evaluate RUN2 --data LOGS", "spelgen report RUN2"]


def _changed(options: Mapping[str, object], defaults: Mapping[str, object]) -> dict[str, object]:
    """Return {name: value} of the options that differ from their defaults; values that are mappings are omitted."""
    changed = {}
    for key, value in options.items():
        if value is not None and value != defaults.get(key) and not isinstance(value, Mapping):
            changed[key] = value
    return changed
