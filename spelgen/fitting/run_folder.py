"""A run folder: what lies in it, written so that at every moment it is complete, and the module it trains."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from spelgen.emission.loading import load_module
from spelgen.errors import RunError
from spelgen.files import write_bytes

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


@dataclass(frozen=True)
class RunFolder:
    """The files of one training run.

    module.py: the trained module's source. robot.urdf, robot.yaml: its robot, where known. config.json: how
    it was trained. metrics.jsonl: a line per epoch. checkpoint.pt: everything needed to go on. model.pt:
    the best state_dict so far. evaluation.json: what `evaluate` found.
    """

    path: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))

    @property
    def module(self) -> Path:
        return self.path / "module.py"

    @property
    def urdf(self) -> Path:
        return self.path / "robot.urdf"

    @property
    def settings(self) -> Path:
        return self.path / "robot.yaml"

    @property
    def config(self) -> Path:
        return self.path / "config.json"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.jsonl"

    @property
    def checkpoint(self) -> Path:
        return self.path / "checkpoint.pt"

    @property
    def weights(self) -> Path:
        return self.path / "model.pt"

    @property
    def evaluation(self) -> Path:
        return self.path / "evaluation.json"

    def require_free(self, *, force: bool) -> None:
        """Raise RunError where a run lies, unless it may be replaced."""
        if self.path.exists() and not self.path.is_dir():
            raise RunError("a file", file=self.path, expected="a folder or a new name")
        if self.config.exists() and not force:
            raise RunError(
                "there is a run in this folder",
                file=self.path,
                do="--resume it, --force to replace it, or -o another",
            )

    def start(self, source: str, urdf: Path | None, *, force: bool) -> None:
        """Make the folder, write the module's source and copy the robot into it. RunError where a run lies, unless
        forced.
        """
        self.require_free(force=force)
        robot = self._robot_files(urdf)  # before anything is removed: they may be this very run's copies
        for old in (
            self.urdf,
            self.settings,
            self.config,
            self.metrics,
            self.checkpoint,
            self.weights,
            self.evaluation,
        ):
            old.unlink(missing_ok=True)
        for path, content in [(self.module, source.encode()), *robot]:
            write_bytes(path, content)

    def _robot_files(self, urdf: Path | None) -> list[tuple[Path, bytes]]:
        if urdf is None:
            return []
        pairs = [(self.urdf, urdf), (self.settings, urdf.with_suffix(".yaml"))]
        return [(to, source.read_bytes()) for to, source in pairs if source.exists()]

    def append_metrics(self, record: dict[str, Any]) -> None:
        """Add one line to metrics.jsonl."""
        with self.metrics.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")

    def write_metrics(self, records: Sequence[dict[str, Any]]) -> None:
        """All lines of metrics.jsonl; no file for none."""
        if records:
            write_bytes(self.metrics, "".join(json.dumps(record) + "\n" for record in records).encode())

    def keep_metrics(self, epochs: int) -> None:
        """Drop lines of epochs after the checkpoint: they will be run again."""
        if self.metrics.exists():
            lines = self.metrics.read_text(encoding="utf-8").splitlines(keepends=True)
            write_bytes(self.metrics, "".join(lines[:epochs]).encode())

    def read_metrics(self) -> list[dict[str, Any]]:
        """The lines of metrics.jsonl, without a last one that is torn."""
        lines = self.metrics.read_text(encoding="utf-8").splitlines() if self.metrics.exists() else []
        records = []
        for count, line in enumerate(lines, start=1):
            try:
                records.append(json.loads(line))
            except ValueError as error:
                if count < len(lines):
                    raise RunError(f"broken JSON ({error})", file=self.metrics, line=count) from error
        return records

    def read_json(self, path: Path) -> dict[str, Any]:
        """One of the folder's JSON files. Raises RunError when it is absent or broken."""
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise RunError(
                "no such run", file=self.path, expected=f"a folder with {path.name}", do="spelgen train"
            ) from None
        except ValueError as error:
            raise RunError(f"broken JSON ({error})", file=path) from error

    def load_state(self, path: Path) -> dict[str, Any]:
        """checkpoint.pt or model.pt, on the CPU; nothing but tensors and plain values is ever unpickled."""
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except FileNotFoundError:
            raise RunError(
                f"no {path.name}", file=self.path, expected="a run folder", do="spelgen train"
            ) from None
        except Exception as error:  # torch names no common type for what a broken file raises
            raise RunError(
                f"unreadable ({type(error).__name__})", file=path, expected="a file of `spelgen train`"
            ) from error


def write_state(path: Path, state: dict[str, Any]) -> None:
    """torch.save, all or nothing."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_bytes(path, buffer.getvalue())


def trained_model(run: RunFolder) -> EmittedModel:
    """A run's module with its best weights, which take no gradients. Raises ModuleError and RunError."""
    model = load_module(run.module)
    model.load_state_dict(run.load_state(run.weights))
    model.requires_grad_(False).eval()
    return model
