"""A trained model as files, and how they are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from spelgen.errors import RunError
from spelgen.files import write_bytes

Format = Literal["urdf", "mjcf", "c", "casadi", "onnx", "torch", "ros2"]
FORMATS: tuple[str, ...] = get_args(Format)

SUFFIXES = {"urdf": ".urdf", "mjcf": ".xml"}
"""Formats of one file, by its extension; what belongs to it lies beside it. All others are folders."""


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
        """Write the files; return their paths. Raises RunError for a path that contradicts the format, and for what
        exists, unless forced.
        """
        places = output_paths(self.to, Path(path), tuple(self.files))
        require_free(self.to, Path(path), places, force=force)
        return tuple(write_bytes(place, self.files[name]) for name, place in places.items())

    def __repr__(self) -> str:
        return f"<Exported {self.robot!r} to {self.to}: {'; '.join(self.summary)}>"


def output_paths(to: str, path: Path, names: Sequence[str]) -> dict[str, Path]:
    """Where each of the files goes. Raises RunError for a path that contradicts the format."""
    require_fitting(to, path)
    if to in SUFFIXES:
        return {name: path.with_name(path.stem + name) for name in names}
    return {name: path / name for name in names}


def require_fitting(to: str, path: Path) -> None:
    """Raise RunError for a path whose extension contradicts the format."""
    suffix = SUFFIXES.get(to)
    if suffix is None and path.suffix and not path.is_dir():
        raise RunError(
            f"the name {path.name!r} for --to {to}",
            expected="a folder, named without an extension",
            do=_hint(path.suffix),
        )
    if suffix is not None and path.suffix != suffix:
        raise RunError(
            f"the name {path.name!r} for --to {to}", expected=f"FILE{suffix}", do=_hint(path.suffix)
        )


def require_free(to: str, path: Path, places: Mapping[str, Path], *, force: bool) -> None:
    """Raise RunError for an output that exists, unless it may be replaced."""
    taken = list(places.values()) if to in SUFFIXES else [path]
    for each in taken:
        if each.exists() and not force:
            raise RunError("this output exists already", file=each, do="force replaces it")


def _hint(suffix: str) -> str | None:
    meant = {ending: name for name, ending in SUFFIXES.items()}.get(suffix)
    return f"--to {meant} writes such a file" if meant else None
