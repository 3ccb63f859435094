"""The function ``export``: a trained model for other tools."""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.emission.specify import arm_of_spec
from spelgen.errors import RunError, suggestion
from spelgen.exporting.describe import Trained
from spelgen.exporting.exported import EXPORTERS, Exported, require_fitting
from spelgen.fitting.fitted import Fit, load_run, required_spec
from spelgen.labels import listed

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel


def export(
    trained: Fit | ArmModel | Path | str,
    to: str = "urdf",
    path: Path | str | None = None,
    *,
    arm: ConfiguredArm | Path | str | None = None,
    force: bool = False,
    entries: Sequence[str] = (),
) -> Exported:
    """Return a fit, the folder of a run or a model in the format of another tool, written where a path is given.

    to: ``urdf``, FILE.urdf with its settings and friction beside it; ``mjcf``, FILE.xml for MuJoCo; ``c``, a folder
    with a C99 header and source; ``ros2``, a colcon package around these; ``casadi``, ``onnx`` and ``torch``, a folder
    with a file for each function. The export is compared with the model first. arm: of ``load_arm`` or the path
    of a URDF; by default the fit's. entries: of c, casadi, onnx and torch, names of the functions that are written; by
    default all but derivatives. Raises RunError where there is no arm, for a preset or a path that does not go with the
    format, where the comparison fails, and where a file exists and ``force`` is not given.
    """
    if to not in EXPORTERS:
        do = suggestion(to, EXPORTERS)
        raise RunError(f"the format {to!r}", expected=f"one of {', '.join(EXPORTERS)}", do=do)
    # before a run is loaded and exported, which takes seconds
    if path is not None:
        require_fitting(to, Path(path))
    if isinstance(trained, str | Path):
        trained = load_run(trained)
    if isinstance(trained, Fit):
        trained, arm = trained.model, arm or trained.urdf
    exporter = EXPORTERS[to]
    if entries and not exporter.choice:
        formats = [name for name, row in EXPORTERS.items() if row.choice]
        raise RunError(f"functions for --to {to}", expected=f"--to {listed(formats)}, which have a choice")
    if arm is None:
        expected = "a run of `spelgen train --robot FILE.urdf`, or an arm"
        raise RunError("no robot.urdf", element="export", expected=expected)
    if not isinstance(arm, ConfiguredArm):
        arm = arm_of_spec(required_spec(trained), arm)
    # its module is imported now: what it needs may be an extra
    exported: Exported = pkgutil.resolve_name(exporter.function_name)(Trained(trained, arm, tuple(entries)))
    if path is not None:
        exported.write(path, force=force)
    return exported
