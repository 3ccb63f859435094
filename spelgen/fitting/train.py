"""Fit an emitted module to log files and leave a run folder: what `spelgen train` does."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spelgen.emission.loading import load_module
from spelgen.errors import Diagnostic, ModuleError, RunError
from spelgen.fitting.fit import AUTOMATIC, QUIET, RunOptions, fit, sample_rates
from spelgen.fitting.fitted import Fit
from spelgen.fitting.run_folder import RunFolder, fitted_model
from spelgen.fitting.run_record import recorded_config
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import BoundedLogs, read_bounded_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import FitConfig
from spelgen.settings.log_mapping import LogMapping
from spelgen.spec import Facts
from spelgen.urdf.document import urdf_bytes

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel


Choice = Callable[[Any, Sequence[float] | None], FitConfig | None]
"""From the model and, where it asks for these by None, the logs' sample rates [Hz]."""


def train(
    module: Path | str,
    data: Iterable[Path | str],
    folder: Path | str,
    config: FitConfig | Choice | None = None,
    *,
    urdf: Path | str | None = None,
    source: Path | str | None = None,
    preprocessing: Preprocessing = AUTOMATIC,
    validation: float | None = None,
    seed: int | None = None,
    trust: bool = False,
    require: Callable[[Sequence[Trajectory]], list[Diagnostic]] | None = None,
    options: RunOptions = QUIET,
) -> Fit:
    """Fit the emitted module to the logs and leave a run folder (see `RunFolder`); see `fit`.

    urdf: the robot the module was built from, for the regularizer and the baselines of `evaluate`; by default the file
    of that name beside the module. source: a run whose module and weights are where the fit starts. trust: the module
    of a run folder is run whatever it is (see `RunFolder.load_module`). config: may also be a function that chooses.
    require: raises where it finds logs wrong, before anything is fitted, or returns what it finds. validation: 0.25 by
    default, seed: 0. What is not said of a run that is resumed is as before, and logs are read as spelgen writes them
    where ``options`` has no mapping. Of logs of more than `LogTuning.kept_bytes` evenly spread segments are fitted.
    Raises ModuleError, LogError, and RunError when the folder holds a run or cannot be resumed with this.
    """
    run, module = RunFolder(folder), Path(module)
    robot = None
    notes: list[Diagnostic] = []
    if options.resume:
        record = run.read_config()  # a missing run is told before anything is read
        config = config or recorded_config(record)
        seed = record["seed"] if seed is None else seed
        validation = validation or record["validation_fraction"]
        if preprocessing is AUTOMATIC:
            preprocessing = Preprocessing(**record["preprocessing"])
        options = replace(options, mapping=options.mapping or LogMapping(**record["mapping"]))
        model = run.load_module(trust=trust)
    else:
        model = load_module(module) if source is None else fitted_model(RunFolder(source), trust=trust)
        robot, notes = robot_of(module, urdf, model.facts)
    chosen = config(model, None) if callable(config) else config  # before logs, which may take long to read
    logs, reading_notes = open_logs(model, data, options.mapping)
    notes += reading_notes
    if require is not None:
        notes += require(logs)
    if chosen is None and callable(config):
        chosen = config(model, sample_rates(logs))
    return fit(
        model, logs, chosen, preprocessing=preprocessing, validation=validation or 0.25, seed=seed or 0, arm=robot,
        folder=folder, options=replace(options, notes=[*options.notes, *notes]),
    )  # fmt: skip


def open_logs(
    model: ArmModel, paths: Iterable[Path | str], mapping: LogMapping | None = None
) -> BoundedLogs:
    """Return the training part of log files, within the bound of memory of `read_bounded_logs`.

    Raises LogError, and SettingsError if the mapping does not fit the joints.
    """
    return read_bounded_logs(list(paths), model, mapping, role="train")


def robot_of(module: Path, urdf: Path | str | None, facts: Facts) -> tuple[Path | None, list[Diagnostic]]:
    """The URDF to copy into the run, and what there is to say about it."""
    path = module.parent / facts.urdf if urdf is None else Path(urdf)
    if not path.is_file():
        if urdf is not None:
            raise RunError("no such file", file=path, expected="the URDF the module was built from")
        message = (
            f"no {facts.urdf} beside the module; pass it by --robot. Without it, evaluation has no baseline with the "
            "URDF's values and needs --trust"
        )
        return None, [Diagnostic("warning", "no-urdf", "run", None, message)]
    if hashlib.sha256(urdf_bytes(path)).hexdigest() == facts.urdf_sha256:
        return path, []
    if urdf is not None:
        raise ModuleError(
            "another URDF than the module was built from", file=path, do="build the module again"
        )
    message = (
        f"{facts.urdf} beside the module has changed since the module was built; it is left out of the run"
    )
    return None, [Diagnostic("warning", "changed-urdf", "run", None, message)]
