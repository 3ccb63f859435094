"""Fit a module to log files and write a run folder: the function behind `spelgen train`."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from spelgen.emission.assemble import load_module
from spelgen.errors import Diagnostic, ModuleError, RunError
from spelgen.fitting.fit import AUTOMATIC, QUIET, FitOptions, RunOptions, choose_config, fit, sample_rates
from spelgen.fitting.fitted import Fit
from spelgen.fitting.run_folder import RunFolder, fitted_model
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import BoundedLogs, read_bounded_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import FitConfig
from spelgen.spec import ModelSpec
from spelgen.urdf.document import urdf_bytes


def train(
    module: Path | str | None,
    data: Iterable[Path | str],
    folder: Path | str,
    config: FitConfig | FitOptions | None = None,
    *,
    urdf: Path | str | None = None,
    source: Path | str | None = None,
    preprocessing: Preprocessing = AUTOMATIC,
    validation: float | None = None,
    seed: int | None = None,
    require: Callable[[Sequence[Trajectory]], list[Diagnostic]] | None = None,
    options: RunOptions = QUIET,
) -> Fit:
    """Fit the module to the logs and write a run folder (see `RunFolder`); further arguments: see `fit`.

    module: the built module. data: log files. urdf: URDF that the module was built from, for the regularizer and the
    baselines; by default, the file with the URDF's original name in the module's folder. source: run folder whose model
    is adapted; used if there is no module. config: a configuration, or options for an objective that depends on the
    logs. require: function that raises an error for unusable logs before the fit, or returns findings. validation,
    seed: by default 0.25 and 0. A resumed run by default uses the recorded values and the recorded mapping of the logs.

    Raises ModuleError, LogError, and RunError if the folder contains a run or cannot be resumed with these arguments.
    """
    run = RunFolder(folder)
    robot = None
    notes: list[Diagnostic] = []
    if options.resume:
        # The record is read first, so that a missing run is reported before the logs are read.
        record = run.read_record()
        config = config or record.config
        seed = record.seed if seed is None else seed
        validation = validation or record.validation_fraction
        if preprocessing is AUTOMATIC:
            preprocessing = record.preprocessing
        options = replace(options, mapping=options.mapping or record.mapping)
        # `fit` loads the weights from the checkpoint
        model = run.untrained_model()
    else:
        model = load_module(module) if module is not None else fitted_model(RunFolder(source or folder))
        robot, notes = robot_of(None if module is None else Path(module), urdf, model.spec)

    @cache
    def logs() -> BoundedLogs:
        return read_bounded_logs(list(data), model, options.mapping, role="train")

    # an option that does not apply is reported before logs are read, which may take long
    config = choose_config(model, config, lambda: sample_rates(logs().trajectories))
    opened, reading_notes = logs()
    notes += reading_notes
    if require is not None:
        notes += require(opened)
    return fit(
        model, opened, config, preprocessing=preprocessing, validation=validation or 0.25, seed=seed or 0, arm=robot,
        folder=folder, options=replace(options, notes=[*options.notes, *notes]),
    )  # fmt: skip


def robot_of(
    module: Path | None, urdf: Path | str | None, spec: ModelSpec
) -> tuple[Path | None, list[Diagnostic]]:
    """Return the path of the URDF to copy into the run folder, None without a URDF, and diagnostics about the URDF."""
    if urdf is not None:
        path = Path(urdf)
    elif module is not None:
        path = module.parent / spec.urdf
    else:
        return None, []
    exists = path.is_file()
    if exists and hashlib.sha256(urdf_bytes(path)).hexdigest() == spec.urdf_sha256:
        return path, []
    if urdf is not None and exists:
        do = "build the module again"
        raise ModuleError("another URDF than the module was built from", file=path, do=do)
    if urdf is not None:
        raise RunError("no such file", file=path, expected="the URDF the module was built from")
    # The user specified no URDF, and the one next to the module is absent or changed: the fit continues without it.
    if exists:
        code = "changed-urdf"
        message = (
            f"{spec.urdf} beside the module has changed since the module was built; it is left out of the run"
        )
    else:
        code = "no-urdf"
        message = (
            f"no {spec.urdf} beside the module; pass it by --robot. Without it, evaluation has no baseline with the "
            "URDF's values, and the run cannot be exported"
        )
    return None, [Diagnostic("warning", code, "run", None, message)]
