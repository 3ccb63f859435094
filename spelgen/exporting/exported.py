"""The formats, a trained model as files of one of them, and how they are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from spelgen.errors import RunError
from spelgen.files import write_bytes
from spelgen.labels import printable

if TYPE_CHECKING:
    from spelgen.exporting.describe import Trained

UNITS = "Units: rad and Nm for revolute joints, m and N for prismatic ones"


@dataclass(frozen=True)
class Exporter:
    """A format of exports.

    function_name: of what takes a ``Trained`` to an ``Exported``; it is imported when it is used, because the
    packages that most formats need are extras. suffix: of a format of one file; all others are folders. choice: whether
    functions can be chosen.
    """

    function_name: str
    suffix: str = ""
    choice: bool = False


EXPORTERS = {
    "urdf": Exporter("spelgen.exporting.urdf_export:export_urdf", suffix=".urdf"),
    "mjcf": Exporter("spelgen.exporting.mjcf_export:export_mjcf", suffix=".xml"),
    "c": Exporter("spelgen.exporting.c_export:export_c", choice=True),
    "casadi": Exporter("spelgen.exporting.casadi_export:export_casadi", choice=True),
    "onnx": Exporter("spelgen.exporting.onnx_export:export_onnx", choice=True),
    "torch": Exporter("spelgen.exporting.torch_export:export_torch", choice=True),
    "ros2": Exporter("spelgen.exporting.ros2_export:export_ros2"),
}
"""The formats by the names that --to takes."""

if TYPE_CHECKING:
    Format = str
else:
    Format = Literal[tuple(EXPORTERS)]


@dataclass(frozen=True, eq=False, repr=False)
class Exported:
    """A trained model for another tool.

    files: contents by name in the folder; of a format of one file, by what follows its stem. summary: what a user
    should know, a sentence each.
    """

    to: str
    robot: str
    files: Mapping[str, bytes]
    summary: tuple[str, ...]

    def write(self, path: Path | str, *, force: bool = False) -> tuple[Path, ...]:
        """Write the files and return their paths.

        Raises RunError for a path that contradicts the format, and for what exists, unless forced.
        """
        path = Path(path)
        require_fitting(self.to, path)
        if EXPORTERS[self.to].suffix:
            paths = [path.with_name(path.stem + name) for name in self.files]
            outputs = paths
        else:
            paths = [path / name for name in self.files]
            outputs = [path]  # a folder of another export is no less in the way than a file
        for output in outputs:
            if output.exists() and not force:
                raise RunError("this output exists already", file=output, do="force replaces it")
        for file, content in zip(paths, self.files.values(), strict=True):
            write_bytes(file, content)
        return tuple(paths)

    def __repr__(self) -> str:
        return f"<Exported {self.robot!r} to {self.to}: {'; '.join(self.summary)}>"


def format_by_extension(path: Path) -> str:
    """Return the format whose files have this extension. Raises RunError where there is none."""
    name = _format_of(path)
    if name is None:
        raise RunError(f"the name {path.name!r}", expected="FILE.urdf, FILE.xml or --to FORMAT")
    return name


def require_fitting(to: str, path: Path) -> None:
    """Raise RunError for a path whose extension contradicts the format."""
    suffix = EXPORTERS[to].suffix
    if path.suffix == suffix or (not suffix and path.is_dir()):
        return
    expected = f"FILE{suffix}" if suffix else "a folder, named without an extension"
    fitting = _format_of(path)
    advice = None if fitting is None else f"--to {fitting} writes such a file"
    raise RunError(f"the name {path.name!r} for --to {to}", expected=expected, do=advice)


def _format_of(path: Path) -> str | None:
    """Return the format of one file with this extension."""
    for name, exporter in EXPORTERS.items():
        if exporter.suffix and exporter.suffix == path.suffix:
            return name
    return None


def folder_export(
    trained: Trained, to: str, tool: str, files: Mapping[str, bytes], *, use: str, about: str, checked: str
) -> Exported:
    """Return an export of several files, with a README beside them; ``about``: what stands behind the units."""
    title = f"Dynamics of {trained.robot} {tool}"
    text = readme(title, use, trained.joint_names, f"{UNITS}; {about}", checked)
    return Exported(to, trained.robot, {**files, "README.md": text}, (checked,))


def readme(title: str, use: str, joints: Sequence[str], conventions: str, checked: str) -> bytes:
    """Return the five lines beside an export: title, use, joints in their order, conventions, result of the check."""
    # names come from a file that anyone may have written
    lines = [f"# {title}", use, f"Joints, in this order: {', '.join(joints)}.", conventions, checked]
    return ("\n".join(map(printable, lines)) + "\n").encode()
