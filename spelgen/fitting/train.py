"""Fit an emitted module to log files and write a run folder: the function behind `spelgen train`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spelgen.emission.loading import load_module
from spelgen.errors import Diagnostic, ModuleError, RunError
from spelgen.fitting.fit import AUTOMATIC, QUIET, RunOptions, fit, sample_rates
from spelgen.fitting.fitted import Fit
from spelgen.fitting.objective import Logs
from spelgen.fitting.objectives import FitOptions, choose_config
from spelgen.fitting.run_folder import RunFolder, fitted_model
from spelgen.fitting.streaming import LargeLogs
from spelgen.logs.arm_mapping import log_source
from spelgen.logs.chunks import large_files
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import FitConfig
from spelgen.settings.log_mapping import LogMapping
from spelgen.spec import Facts
from spelgen.urdf.document import urdf_bytes

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


def train(
    module: Path | str,
    data: Iterable[Path | str],
    folder: Path | str,
    config: FitConfig | FitOptions | None = None,
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
    """Fit the emitted module to the logs and write a run folder (see `RunFolder`); see `fit`.

    urdf: the robot the module was built from, for the regularizer and the baselines; by default the file
    of that name beside the module. source: a run whose module and weights are where the fit starts. trust: the module
    of a run folder is run whatever it is (see `RunFolder.load_module`). config: may also be options, for an objective
    that depends on the logs. require: raises for logs that are wrong, before anything is fitted, or returns findings;
    logs larger than memory are not passed to it. validation: 0.25 by default, seed: 0. For a resumed run all of these
    are by default as before, and logs are read as spelgen writes them if ``options`` has no mapping.
    Raises ModuleError, LogError, and RunError when the folder contains a run or cannot be resumed with this.
    """
    run, module = RunFolder(folder), Path(module)
    robot = None
    notes: list[Diagnostic] = []
    if options.resume:
        record = run.read_record()  # a missing run is reported before anything is read
        config = config or record.config
        seed = record.seed if seed is None else seed
        validation = validation or record.validation_fraction
        if preprocessing is AUTOMATIC:
            preprocessing = record.preprocessing
        options = replace(options, mapping=options.mapping or record.mapping)
        model = run.load_module(trust=trust)
    else:
        model = load_module(module) if source is None else fitted_model(RunFolder(source), trust=trust)
        robot, notes = robot_of(module, urdf, model.facts)

    @cache
    def logs() -> Logs:
        return open_logs(model, data, options.mapping, preprocessing)

    # an option that does not apply is reported before logs are read, which may take long
    config = choose_config(model, config, lambda: sample_rates(logs()))
    opened = logs()
    if require is not None and not isinstance(opened, LargeLogs):
        notes += require(opened)
    return fit(
        model, opened, config, preprocessing=preprocessing, validation=validation or 0.25, seed=seed or 0, arm=robot,
        folder=folder, options=replace(options, notes=[*options.notes, *notes]),
    )  # fmt: skip


def open_logs(
    model: EmittedModel,
    paths: Iterable[Path | str],
    mapping: LogMapping | None = None,
    preprocessing: Preprocessing = AUTOMATIC,
) -> Logs:
    """Return the training part of log files; of Parquet larger than memory one chunk at a time.

    Raises LogError, and SettingsError if the mapping does not fit.
    """
    paths, source = list(paths), log_source(model, mapping)
    large = large_files(paths, source.joints, role="train")
    if large:
        kinds = tuple(model.joint_types)
        return LargeLogs(tuple(large), source.joints, kinds, source.mapping, preprocessing.gap)
    return read_logs(paths, model, mapping, role="train")


def robot_of(module: Path, urdf: Path | str | None, facts: Facts) -> tuple[Path | None, list[Diagnostic]]:
    """Return the URDF to copy into the run, None without one, and diagnostics about it."""
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
