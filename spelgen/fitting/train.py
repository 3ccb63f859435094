"""Fit a module to log files and write a run folder: the function behind `spelgen train`."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

from spelgen.emission.assemble import load_module
from spelgen.errors import Diagnostic, ModuleError, RunError
from spelgen.fitting.fit import QUIET, FitOptions, RunOptions, choose_config, fit, sample_rates
from spelgen.fitting.fitted import Fit
from spelgen.fitting.run_folder import RunFolder, fitted_model
from spelgen.fitting.run_record import Record
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
    of_logs: Mapping[str, Any] | None = None,
    require: Callable[[Sequence[Trajectory]], list[Diagnostic]] | None = None,
    options: RunOptions = QUIET,
) -> Fit:
    """Fit the module to the logs and write a run folder (see `RunFolder`).

    If `options.resume` is True, the run in the folder is resumed. It uses the recorded options and the recorded mapping
    of the logs, unless the arguments replace them.

    Args:
        module: the built module; None: the fit continues from the model of ``source``.
        data: log files.
        config: a configuration, or options by name; the default objective depends on the logs.
        urdf: URDF that the module was built from, for the regularizer and the baselines; by default, the file with the
            URDF's original name in the module's folder.
        source: run folder with the fitted model, used only if ``module`` is None; by default ``folder``.
        of_logs: dict with fields of `Preprocessing`, validation_fraction and seed.
        require: function that checks the logs before the fit: it raises an error for unusable logs and returns
            diagnostics.
        options: device, files and messages of the run (see `RunOptions`).

    Raises ModuleError, LogError, and RunError if the folder contains a run or cannot be resumed with these arguments.
    """
    run = RunFolder(folder)
    robot, notes, settings = None, list[Diagnostic](), dict(of_logs or {})
    if options.resume:
        # The record of the run (config.json) is read first, so that a folder without a run is reported before the logs
        # are read.
        record = run.read_record()
        # Validation logs that were passed from Python are not stored in a file, so this function cannot resume the run.
        if record.validation_fraction is None and record.validation:
            raise RunError(
                "a run whose validation logs were passed from Python", file=run.path,
                do="resume it by spelgen.fit(..., folder=..., options=spelgen.RunOptions(resume=True))",
            )  # fmt: skip
        config = _resumed(config, record)
        recorded = {"seed": record.seed, "validation_fraction": record.validation_fraction}
        settings = {**recorded, **asdict(record.preprocessing), **settings}
        options = replace(options, mapping=options.mapping or record.mapping)
        # The model is made with initial weights: `fit` loads the fitted weights from the checkpoint.
        model = run.untrained_model()
    else:
        model = load_module(module) if module is not None else fitted_model(RunFolder(source or folder))
        robot, notes = robot_of(None if module is None else Path(module), urdf, model.spec)
    seed, validation = settings.pop("seed", 0), settings.pop("validation_fraction", None) or 0.25

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
        model, opened, config, preprocessing=Preprocessing(**settings), validation=validation, seed=seed, arm=robot,
        folder=folder, options=replace(options, notes=[*options.notes, *notes]),
    )  # fmt: skip


def _resumed(config: FitConfig | FitOptions | None, record: Record) -> FitConfig | FitOptions:
    """Return the configuration of a resumed fit: the recorded options, replaced by the options in `config`."""
    if not isinstance(config, FitOptions):
        return config or record.config
    objective, options = config.objective or record.objective, config.options
    if objective == record.objective:
        options = {**record.options, **options}
    return FitOptions(objective, options)


def robot_of(
    module: Path | None, urdf: Path | str | None, spec: ModelSpec
) -> tuple[Path | None, list[Diagnostic]]:
    """Return the path of the URDF for the run folder (None if there is none), and diagnostics about the URDF.

    The URDF is `urdf` or, if `urdf` is None, the file named in `spec` in the folder of `module`. It must be the URDF
    from which the module was built:

    - If `urdf` is given, ModuleError is raised for another URDF, and RunError if there is no such file.
    - If the file in the folder of `module` is absent or changed, the path is None, and a warning is returned.
    - If `urdf` and `module` are None, the path is None, without a warning.
    """
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
