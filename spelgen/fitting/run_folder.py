"""A run folder: what lies in it, written so that at every moment it is complete, and the module it trains."""

from __future__ import annotations

import hashlib
import inspect
import io
import json
import os
import sys
from dataclasses import dataclass
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any, cast

import torch

from spelgen.errors import ModuleError, RunError

METHODS = (
    "mass_matrix", "potential_energy", "dissipation", "momentum", "velocity", "hamiltonian",
    "forward_dynamics", "inverse_dynamics", "forward", "prepare", "rates",
)  # fmt: skip


if TYPE_CHECKING:

    class EmittedModel(torch.nn.Module):
        """The class `Model` of an emitted module, whose own docstrings hold shapes and units."""

        n: int
        joint_names: tuple[str, ...]
        joint_types: tuple[str, ...]

        def mass_matrix(self, q: torch.Tensor) -> torch.Tensor: ...
        def potential_energy(self, q: torch.Tensor) -> torch.Tensor: ...
        def gravity(self, q: torch.Tensor) -> torch.Tensor: ...
        def input_matrix(self, q: torch.Tensor) -> torch.Tensor: ...
        def dissipation(self, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor: ...
        def momentum(self, q: torch.Tensor, qd: torch.Tensor, prepared: Any = None) -> torch.Tensor: ...
        def velocity(self, q: torch.Tensor, p: torch.Tensor, prepared: Any = None) -> torch.Tensor: ...
        def hamiltonian(self, q: torch.Tensor, p: torch.Tensor) -> torch.Tensor: ...
        def inverse_dynamics(self, q: torch.Tensor, qd: torch.Tensor, qdd: torch.Tensor) -> torch.Tensor: ...
        def forward(self, t: torch.Tensor, state: torch.Tensor) -> torch.Tensor: ...
        def to_group(self, q: torch.Tensor) -> list[torch.Tensor]: ...
        def prepare(self) -> Any: ...
        def rates(
            self, q: torch.Tensor, p: torch.Tensor, tau: torch.Tensor | None, prepared: Any
        ) -> tuple[torch.Tensor, torch.Tensor]: ...


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

    def start(self, module: Path, urdf: Path | None, *, force: bool) -> None:
        """Make the folder and copy module and robot into it. RunError where a run lies, unless forced."""
        if self.path.exists() and not self.path.is_dir():
            raise RunError("a file", file=self.path, expected="a folder or a new name")
        if self.config.exists() and not force:
            raise RunError(
                "there is a run in this folder",
                file=self.path,
                do="--resume it, --force to replace it, or -o another",
            )
        source = module.read_bytes()  # before anything is removed: the module may be this very run's copy
        robot = self._robot_files(urdf)
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
        self.path.mkdir(parents=True, exist_ok=True)
        for path, content in [(self.module, source), *robot]:
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

    def keep_metrics(self, epochs: int) -> None:
        """Drop lines of epochs after the checkpoint: they will be run again."""
        if self.metrics.exists():
            lines = self.metrics.read_text(encoding="utf-8").splitlines(keepends=True)
            write_bytes(self.metrics, "".join(lines[:epochs]).encode())

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


def write_bytes(path: Path, content: bytes) -> None:
    """All or nothing, also through a power cut: a flushed neighbour takes the file's place."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with unfinished.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def write_state(path: Path, state: dict[str, Any]) -> None:
    """torch.save, all or nothing."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_bytes(path, buffer.getvalue())


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Indented JSON, all or nothing."""
    write_bytes(path, (json.dumps(content, indent=2) + "\n").encode())


def trained_model(run: RunFolder) -> EmittedModel:
    """A run's module with its best weights, which take no gradients. Raises ModuleError and RunError."""
    model = load_model(run.module)
    model.load_state_dict(run.load_state(run.weights))
    model.requires_grad_(False).eval()
    return model


class _Loader(SourceFileLoader):
    """Leaves no __pycache__ beside the module, nor is misled by one."""

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


def load_model(path: Path | str) -> EmittedModel:
    """An instance of the emitted module's class `Model`.

    The file is imported under a private name made from its content, so that two modules never meet.
    Raises ModuleError when it cannot be imported or is no emitted module.
    """
    path = Path(path)
    if not path.is_file():
        raise ModuleError("no such file", file=path, expected="a module made by `spelgen build`")
    name = f"_spelgen_module_{hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"
    loader = _Loader(name, str(path))
    module = sys.modules[name] = ModuleType(name)  # torch.compile looks for it there
    try:
        loader.exec_module(module)
        model = module.Model()
    except AttributeError as error:
        raise ModuleError(
            f"no class Model ({error})", file=path, expected="a module made by `spelgen build`"
        ) from error
    except Exception as error:
        raise ModuleError(
            f"import fails ({type(error).__name__}: {error})", file=path, do="build it again"
        ) from error
    missing = [name for name in ("n", "joint_names", "joint_types", *METHODS) if not hasattr(model, name)]
    if missing or not isinstance(model, torch.nn.Module):
        raise ModuleError(
            f"a class Model without {', '.join(missing)}", file=path,
            expected="a module made by `spelgen build`",
        )  # fmt: skip
    emitted = cast("EmittedModel", model)
    if "prepared" not in inspect.signature(emitted.momentum).parameters:
        raise ModuleError("a module of an older spelgen", file=path, do="build it again")
    return emitted
