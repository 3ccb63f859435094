"""The function ``export``: write a trained model in the format of another tool."""

import pkgutil
from collections.abc import Sequence
from pathlib import Path

from spelgen.arm.configured_arm import Arm
from spelgen.emission.assemble import ArmModel
from spelgen.emission.specify import arm_of_spec
from spelgen.errors import RunError, suggestion
from spelgen.exporting.describe import Trained
from spelgen.exporting.exported import EXPORTERS, WITH_FLOAT32, WITH_FUNCTIONS, Exported, require_fitting
from spelgen.fitting.fitted import Fit, load_run, required_spec
from spelgen.labels import listed
from spelgen.listing import Listing
from spelgen.live.noise import stored_levels


def export(
    trained: Fit | ArmModel | Path | str,
    to: str = "urdf",
    path: Path | str | None = None,
    *,
    arm: Arm | Path | str | None = None,
    force: bool = False,
    entries: Sequence[str] = (),
    float32: bool = False,
) -> Exported:
    """Return a trained model in the format of another tool, and write it to a path, if one is given.

    The results of the export are compared with the results of the model.

    Args:
        trained: a fit, the folder of a run, or a model.
        to: ``urdf``: FILE.urdf, with settings and friction in further files; ``mjcf``: FILE.xml for MuJoCo; ``c``: a
            folder with a C99 header and source; ``ros2``: a colcon package with the C files; ``casadi``, ``onnx``,
            ``torch``: a folder with a file for each function.
        path: file or folder to write; None: nothing is written.
        arm: result of ``load_arm``, or the path of a URDF; default: the arm of the fit.
        force: replace existing files.
        entries: names of the functions for c, casadi, onnx and torch; default: all.
        float32: whether onnx and torch programs compute in float32, for accelerators; default: float64.

    Raises RunError without an arm, for a model or a path that the format does not allow, if the comparison fails, and
    if a file exists without ``force``.
    """
    if to not in EXPORTERS:
        do = suggestion(to, EXPORTERS)
        raise RunError(f"the format {to!r}", expected=f"one of {', '.join(EXPORTERS)}", do=do)
    # The path of the export is checked first, because loading and exporting a run takes seconds.
    if path is not None:
        require_fitting(to, Path(path))
    if isinstance(trained, str | Path):
        trained = load_run(trained)
    intervals: tuple[Listing, ...] = ()
    levels = None
    # A fit has 95 % intervals of its parameters, and noise levels of the estimator. The export contains both; a model
    # that is given without its fit has neither.
    if isinstance(trained, Fit):
        levels = stored_levels(trained)
        if trained.checkpoint.posterior:
            intervals = trained.posterior.listings
        trained, arm = trained.model, arm or trained.urdf
    if entries and to not in WITH_FUNCTIONS:
        raise RunError(
            f"functions for --to {to}", expected=f"--to {listed(WITH_FUNCTIONS)}, which have a choice"
        )
    if float32 and to not in WITH_FLOAT32:
        raise RunError(f"float32 for --to {to}", expected=f"--to {listed(WITH_FLOAT32)}; C has -DNAME_FLOAT")
    if arm is None:
        expected = "a run of `spelgen train --robot FILE.urdf`, or an arm"
        raise RunError("no robot.urdf", element="export", expected=expected)
    if not isinstance(arm, Arm):
        arm = arm_of_spec(required_spec(trained), arm)
    # The exporter is imported here, because packages of other formats may not be installed.
    export_model = pkgutil.resolve_name(f"spelgen.exporting.{to}_export:export_{to}")
    exported: Exported = export_model(Trained(trained, arm, tuple(entries), intervals, float32, levels))
    if path is not None:
        exported.write(path, force=force)
    return exported
