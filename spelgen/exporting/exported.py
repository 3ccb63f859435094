"""The properties of an export format (``Exporter``), and the files of an export (``Exported``) with their README."""

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

# All formats have these units, and the README of every export states them.
UNITS = "Units: rad and Nm for revolute joints, m and N for prismatic ones"


@dataclass(frozen=True)
class Exporter:
    """A format to which models are exported, such as urdf or onnx.

    Attributes:
        title: end of the title "Dynamics of <arm> ..." of the README in an export, such as "in C99".
        suffix: file name extension; empty for a format that is a folder.
    """

    title: str
    suffix: str = ""


EXPORTERS = {
    "urdf": Exporter("as a URDF", suffix=".urdf"),
    "mjcf": Exporter("for MuJoCo", suffix=".xml"),
    "c": Exporter("in C99"),
    "casadi": Exporter("in CasADi"),
    "onnx": Exporter("in ONNX"),
    "torch": Exporter("in torch"),
    "ros2": Exporter("for ROS 2"),
}
"""The formats, by the values of --to. The function `export_NAME` of the file `NAME_export` makes the export."""
WITH_FUNCTIONS = ("c", "casadi", "onnx", "torch")
"""The formats that consist of functions, which a user can select."""
WITH_FLOAT32 = ("onnx", "torch")
"""The formats whose programs can compute in float32."""
# A file name specifies a format only if the format is a single file: folders have no suffix.
_BY_SUFFIX = {exporter.suffix: name for name, exporter in EXPORTERS.items() if exporter.suffix}

if TYPE_CHECKING:
    Format = str
else:
    Format = Literal[tuple(EXPORTERS)]


@dataclass(frozen=True, eq=False, repr=False)
class Exported:
    """A trained model in the format of another tool: the content of its files.

    Attributes:
        to: name of the format.
        robot: name of the arm.
        files: {path in the folder: content}. For a format that is a single file, the keys are extensions such as
            ``.urdf``, which replace the extension of the file name.
        summary: sentences for the user.
    """

    to: str
    robot: str
    files: Mapping[str, bytes]
    summary: tuple[str, ...]

    def write(self, path: Path | str, *, force: bool = False) -> tuple[Path, ...]:
        """Write the files to ``path``, the name of a file or folder; return the paths of all files.

        Raises RunError if the extension of the path contradicts the format, or if files exist and ``force`` is False.
        """
        path = Path(path)
        require_fitting(self.to, path)
        is_folder = not EXPORTERS[self.to].suffix
        paths = [path / name if is_folder else path.with_name(path.stem + name) for name in self.files]
        # Without `force`, a folder must not exist: the files could be mixed with other files.
        for output in [path] if is_folder else paths:
            if output.exists() and not force:
                raise RunError("this output exists already", file=output, do="force replaces it")
        for file, content in zip(paths, self.files.values(), strict=True):
            write_bytes(file, content)
        return tuple(paths)

    def __repr__(self) -> str:
        return f"<Exported {self.robot!r} to {self.to}: {'; '.join(self.summary)}>"


def format_by_extension(path: Path) -> str:
    """Return the name of the export format with the extension of `path`. Raises RunError if no format has it."""
    if path.suffix not in _BY_SUFFIX:
        raise RunError(f"the name {path.name!r}", expected="FILE.urdf, FILE.xml or --to FORMAT")
    return _BY_SUFFIX[path.suffix]


def require_fitting(to: str, path: Path) -> None:
    """Raise RunError if the extension of an output path contradicts the export format `to`."""
    suffix = EXPORTERS[to].suffix
    if path.suffix == suffix or (not suffix and path.is_dir()):
        return
    expected = f"FILE{suffix}" if suffix else "a folder, named without an extension"
    advice = None
    if path.suffix in _BY_SUFFIX:
        advice = f"--to {_BY_SUFFIX[path.suffix]} writes such a file"
    raise RunError(f"the name {path.name!r} for --to {to}", expected=expected, do=advice)


def with_readme(
    trained: Trained,
    to: str,
    files: Mapping[str, bytes],
    *,
    use: str,
    about: str,
    summary: Sequence[str],
    example: Sequence[str] = (),
) -> Exported:
    """Return an export whose files include a README for its users.

    Args:
        trained: the model and its arm.
        to: name of the format.
        files: contents by file name.
        use: first line after the title, how the export is used.
        about: conventions of the format. The README states them after the units and the tip, in the same line.
        summary: results of the checks, one text without a full stop each.
        example: lines of Python that run in the folder of the README.
    """
    exporter, arm = EXPORTERS[to], trained.arm.chain
    tip = trained.arm.tip or trained.arm.robot.last_link(arm.joint_names)
    # Before examples and tables, the README has only the five lines that a user needs for the first call; details are
    # in docs/deploy.md.
    head = [
        f"# Dynamics of {arm.name} {exporter.title}",
        use,
        f"Joints, in this order: {', '.join(arm.joint_names)}.",
        f"{UNITS}; the tip is the link {tip}; {about}",
        f"{'; '.join(summary)}.",
    ]
    # Names come from an untrusted URDF, so characters that are not printable are replaced.
    text = "\n".join(map(printable, head)) + "\n"
    blocks = [("python", example)] if example else []
    blocks += [("text", list(map(printable, table.text().splitlines()))) for table in trained.intervals]
    for language, lines in blocks:
        text += "\n".join(["", f"```{language}", *lines, "```", ""])
    name = f"{exporter.suffix}.README.md" if exporter.suffix else "README.md"
    return Exported(to, arm.name, {**files, name: text.encode()}, tuple(summary))
