"""Facts about a run for its page: training, options, and commands that reproduce the run."""

import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

from spelgen.arm.configured_arm import Arm
from spelgen.emission.assemble import ArmModel
from spelgen.emission.specify import arm_of_spec
from spelgen.errors import SpelgenError, shortened
from spelgen.evaluation.results import Results
from spelgen.fitting.posterior import Posterior, posterior_of
from spelgen.fitting.run_folder import RunFolder, fitted_model
from spelgen.fitting.run_record import Content, Record
from spelgen.fitting.torque.report import terms_in_use
from spelgen.labels import MODEL, counted, share
from spelgen.listing import duration, number
from spelgen.logs.preprocessing import Preprocessing
from spelgen.render.charts import TUNING
from spelgen.runtime.residual_terms import ResidualDynamics
from spelgen.settings.fits import CONFIGS
from spelgen.settings.training import TrainingSettings
from spelgen.spec import ModelSpec, Options


class Run:
    """The content of a run folder, read for its page; except for `baselines`, an attribute without a file is None.

    Attributes:
        config: Record of the fit.
        baselines: Content of least_squares.json; {} if the file is absent.
        arm: Arm of the URDF; None also if the URDF cannot be read, in which case the page has no picture of the arm.
    """

    def __init__(self, path: Path | str) -> None:
        """Read the files of the run folder `path`. Raises RunError or ModuleError."""
        folder = self.folder = RunFolder(path)
        self.spec = folder.read_spec()
        self.config = folder.read_record() if folder.config.is_file() else None
        self.baselines = folder.read_baselines()
        self.results: Results | None = None
        if folder.evaluation.is_file():
            self.results = Results.from_dict(folder.read_json(folder.evaluation))
        self.arm: Arm | None = None
        if folder.urdf.exists():
            # An unreadable URDF is no error: results do not depend on it, only the picture of the arm is omitted.
            with suppress(SpelgenError):
                self.arm = arm_of_spec(self.spec, folder.urdf)

    @cached_property
    def metrics(self) -> list[Content]:
        """Records of the training, one per epoch, with its losses; empty for a fit without epochs."""
        return self.folder.read_metrics()

    @cached_property
    def model(self) -> ArmModel | None:
        """The trained model of the run; None for a run without weights."""
        if not self.folder.weights.is_file():
            return None
        return fitted_model(self.folder).requires_grad_(False).eval()

    @cached_property
    def posterior(self) -> Posterior | None:
        """Posterior distribution of the parameters of the trained model; None if its checkpoint has none."""
        if self.model is None or self.config is None or not self.folder.checkpoint.is_file():
            return None
        content = self.folder.load_checkpoint().posterior
        # `delay`: time by which the fit has shifted the logged torques [s]; shown in the tables of the posterior.
        delay = self.config.preprocessing.torque_delay or 0.0
        return None if content is None else posterior_of(self.model, content, delay, self.folder.checkpoint)


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


def best_epoch(metrics: Sequence[Content]) -> int:
    """Return the epoch of the best model (validation loss); 0 if no epoch was better than the initial model.

    metrics: records of the training, one per epoch.
    """
    # "best" of the last record is the smallest validation loss of the fit, including the loss of the initial model.
    best = metrics[-1]["best"]
    return next((epoch["epoch"] for epoch in metrics if epoch["validation"] == best), 0)


def training_facts(run: Run, record: Record) -> dict[str, str]:
    """Return {label: text} about the logs, the preprocessing and the duration of a fit."""
    preprocessing = record.preprocessing
    facts = {
        "objective": record.objective,
        "training logs": _names(record.training),
        "validation logs": _names(record.validation),
        "windows": f"{record.training_windows:,} for training, {record.validation_windows:,} for validation",
        "filter": f"{preprocessing.cutoff:g} Hz, zero phase" if preprocessing.filtered else "none",
    }
    if isinstance(run.model, ResidualDynamics):
        facts["residual terms"] = "; ".join(terms_in_use(run.model)) or "none selected"
    # Only fits with epochs have metrics; fits to torques have none.
    if run.metrics:
        last, best = run.metrics[-1], best_epoch(run.metrics)
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


def settings(record: Record) -> dict[str, str]:
    """Return {name: value} of the options of a fit, both as text for the page about a run."""
    options = record.options.items()
    return {key.replace("_", " "): str(value) for key, value in options if value is not None}


def _names(trajectories: Sequence[str]) -> str:
    count = counted(len(trajectories), "trajectory")
    return f"{count}: {shortened(trajectories, 5)}" if trajectories else "none"


def commands(run: RunFolder, spec: ModelSpec, record: Record | None) -> list[str]:
    """Return the commands of a shell that reproduce a run, for its page.

    The run does not record the paths of its logs, so the commands contain the placeholder LOGS.
    """
    # Options of `spelgen build` with default values are omitted, to keep the command short.
    options = asdict(spec.options)
    # The run folder has no copy of the design's YAML file, so the command names a file of the user.
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
    lines = [f"{build} -o module.py"]
    if record:
        objective = record.objective
        train = f"spelgen train module.py{option} --data LOGS -o RUN2 --objective {objective}"
        defaults = CONFIGS[objective]().model_dump(mode="json") | asdict(Preprocessing())
        defaults |= TrainingSettings().model_dump(include={"validation_fraction", "seed"})
        options = {"validation_fraction": record.validation_fraction, "seed": record.seed}
        options |= record.options | asdict(record.preprocessing)
        for key, value in _changed(options, defaults).items():
            train += f" --set {shlex.quote(f'{key}={value}')}"
        # A mapping in the run folder has replaced the mapping in the settings of the robot, so the command must specify
        # it.
        if run.mapping.exists():
            train += f" --mapping RUN/{run.mapping.name}"
        lines.append(train)
    return [*lines, "spelgen evaluate RUN2 --data LOGS", "spelgen report RUN2"]


def _changed(options: Mapping[str, object], defaults: Mapping[str, object]) -> dict[str, object]:
    """Return {name: value} of the options that differ from their defaults; values that are mappings are omitted."""
    changed = {}
    for key, value in options.items():
        if value is not None and value != defaults.get(key) and not isinstance(value, Mapping):
            changed[key] = value
    return changed
