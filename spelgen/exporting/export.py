"""A trained model for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from spelgen.errors import RunError, suggestion
from spelgen.exporting.exported import FORMATS, Exported, require_fitting
from spelgen.exporting.trained import Trained
from spelgen.fitting.fitted import Fit, load_run
from spelgen.loaded_arm import LoadedArm, load_arm


def export(
    trained: Any, to: str = "urdf", path: Path | str | None = None, *, arm: Any = None, force: bool = False
) -> Exported:
    """What a fit, the folder of a run or a model has learned, for other tools; written where a path is given.

    to: ``urdf``, FILE.urdf with its settings and friction beside it; ``mjcf``, FILE.xml for MuJoCo; ``c``, a folder
    with a C99 header and source; ``ros2``, a colcon package around these; ``casadi``, ``onnx`` and ``torch``, a folder
    with a file for each function. What is written was compared with the model first. arm: of ``load_arm`` or the path
    of a URDF; by default the fit's. Raises RunError where no arm is known, for a preset or a path that does not go with
    the format, where the comparison fails, and where a file exists and ``force`` is not given.
    """
    if to not in FORMATS:
        raise RunError(
            f"the format {to!r}", expected=f"one of {', '.join(FORMATS)}", do=suggestion(to, FORMATS)
        )
    if path is not None:
        require_fitting(to, Path(path))
    fit = load_run(trained) if isinstance(trained, str | Path) else trained
    model, urdf = (fit.model, fit.urdf) if isinstance(fit, Fit) else (fit, None)
    found = _exported(to, Trained(model, _arm(model, urdf if arm is None else arm)))
    if path is not None:
        found.write(path, force=force)
    return found


def _exported(to: str, trained: Trained) -> Exported:
    # what each needs is an extra: everything else works without
    if to == "c":
        from spelgen.exporting.c_export import export_c

        return export_c(trained)
    if to == "ros2":
        from spelgen.exporting.ros2_export import export_ros2

        return export_ros2(trained)
    if to == "onnx":
        from spelgen.exporting.onnx_export import export_onnx

        return export_onnx(trained)
    if to == "torch":
        from spelgen.exporting.torch_export import export_torch

        return export_torch(trained)
    if to == "mjcf":
        from spelgen.exporting.mjcf_export import export_mjcf

        return export_mjcf(trained)
    if to == "casadi":
        from spelgen.exporting.casadi_export import export_casadi

        return export_casadi(trained)
    from spelgen.exporting.urdf_export import export_urdf

    return export_urdf(trained)


def _arm(model: Any, known: Any) -> LoadedArm:
    if isinstance(known, LoadedArm):
        return known
    if known is None:
        raise RunError(
            "no robot.urdf",
            element="export",
            expected="a run of `spelgen train --robot FILE.urdf`, or an arm",
        )
    options = model.facts.options
    return load_arm(known, model.facts.joints, angle_tolerance=options.angle_tolerance)
