"""The files of a run folder, and the model of a run. A file is written completely or not at all."""

import io
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from zipfile import ZipFile

import torch
from torch import Tensor

from spelgen.emission.assemble import ArmModel, assemble
from spelgen.errors import ModuleError, RunError
from spelgen.files import local, read_bytes, read_json, remove, require_regular_file, write_bytes
from spelgen.fitting.run_record import Checkpoint, Content, Epoch, Record, require
from spelgen.spec import ModelSpec, spec_from_json
from spelgen.urdf.document import urdf_bytes


class RunFolder:
    """The files of one training run.

    Attributes:
        spec: specification of the model.
        urdf, settings: URDF and settings of the robot, if known.
        mapping: names and units of the columns of the logs, in the format of --mapping.
        config: record of the fit.
        metrics: one line per epoch.
        checkpoint: state from which the fit is resumed.
        weights: the best state_dict so far.
        evaluation: results of `evaluate`.
        baseline: least-squares baselines, and the range of motion of the training logs.
        estimator: noise levels of the state estimator.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = local(path)
        self.config = self.path / "config.json"
        self.spec = self.path / "spec.json"
        self.urdf = self.path / "robot.urdf"
        self.settings = self.path / "robot.yaml"
        self.mapping = self.path / "mapping.yaml"
        self.metrics = self.path / "metrics.jsonl"
        self.checkpoint = self.path / "checkpoint.pt"
        self.weights = self.path / "model.pt"
        self.evaluation = self.path / "evaluation.json"
        self.baseline = self.path / "least_squares.json"
        self.estimator = self.path / "estimator.json"

    def require_free(self, *, force: bool) -> None:
        """Raise RunError if the folder contains a run, unless ``force`` permits to replace it."""
        if self.path.exists() and not self.path.is_dir():
            raise RunError("a file", file=self.path, expected="a folder or a new name")
        if self.config.exists() and not force:
            do = "--resume it, --force to replace it, or -o another"
            raise RunError("there is a run in this folder", file=self.path, do=do)

    @contextmanager
    def started(self, spec: ModelSpec, urdf: Path | None, *, force: bool) -> Iterator[None]:
        """Context manager that makes the folder, writes the specification, and copies the robot's URDF and settings.

        Files of a previous run are removed. A folder contains a run if it contains config.json. The caller writes this
        file last, inside the context, so that a run always has all its files. If the code inside the context raises an
        exception, the files written so far are removed. Raises RunError if the folder contains a run and ``force`` is
        False.
        """
        self.require_free(force=force)
        content = {self.spec: f"{spec.to_json()}\n".encode()}
        # The URDF is read before files are removed: it may be the copy in this folder.
        if urdf is not None and urdf.exists():
            content[self.urdf] = urdf_bytes(urdf)  # stores the expanded URDF of a xacro file
        if urdf is not None and (settings := urdf.with_suffix(".yaml")).is_file():
            content[self.settings] = settings.read_bytes()
        # The files are removed in the order of `__init__`. The first one is config.json, which marks the folder as a
        # run: if the removal is interrupted, the folder is not treated as a run.
        files = [x for x in vars(self).values() if x != self.path]
        try:
            for file in files:
                remove(file)
            for file, written in content.items():
                write_bytes(file, written)
            yield
        except BaseException:
            for file in files:
                remove(file)
            raise

    def save(self, history: Sequence[Content], weights: Content, checkpoint: Content) -> None:
        """Write the history to metrics.jsonl, the best weights to model.pt, and the checkpoint to checkpoint.pt."""
        # The metrics are written before the checkpoint: after an interruption between the two, a resumed run removes
        # the surplus lines from the metrics.
        self.write_metrics(history)
        write_state(self.weights, weights)
        write_state(self.checkpoint, checkpoint)

    def write_metrics(self, records: Sequence[Content]) -> None:
        """Write metrics.jsonl with one line per record; without records, remove the file."""
        if records:
            write_bytes(self.metrics, "".join(json.dumps(record) + "\n" for record in records).encode())
        else:
            remove(self.metrics)

    def read_metrics(self) -> list[Content]:
        """Return the records of metrics.jsonl. The last line is ignored if it is incomplete."""
        if not self.metrics.exists():
            return []
        records, lines = [], read_bytes(self.metrics, RunError).decode("utf-8", "replace").splitlines()
        for count, line in enumerate(lines, start=1):
            try:
                record = json.loads(line)
                require(Epoch, record, self.metrics, count)
                records.append(record)
            except (ValueError, RecursionError) as error:
                if count < len(lines):
                    raise RunError(f"broken JSON ({error})", file=self.metrics, line=count) from error
        return records

    def read_json(self, path: Path) -> Content:
        """Return the object in a JSON file of the folder. Raises RunError if the file is absent or broken."""
        if not path.exists():
            raise self._no_run(path)
        return read_json(path, RunError)

    def _no_run(self, missing: Path) -> RunError:
        expected = f"a folder with {missing.name}"
        return RunError("no such run", file=self.path, expected=expected, do="make one with `spelgen train`")

    def read_record(self) -> Record:
        """Return the record of the fit in config.json.

        Raises RunError if the file is absent or broken, lacks a key, or has a key of another type.
        """
        return require(Record, self.read_json(self.config), self.config)

    def read_baselines(self) -> Content:
        """Return the baselines in least_squares.json, {} if there are none. Raises RunError if the file is broken."""
        return self.read_json(self.baseline) if self.baseline.exists() else {}

    def load_checkpoint(self) -> Checkpoint:
        """Return the checkpoint of the fit in checkpoint.pt.

        Raises RunError if the file is absent or broken, lacks a key, or has a key of another type.
        """
        checkpoint = require(Checkpoint, self.load_state(self.checkpoint), self.checkpoint)
        _require_finite(checkpoint.best_weights, self.checkpoint)
        return checkpoint

    def load_state(self, path: Path) -> Content:
        """Return the content of checkpoint.pt or model.pt, on the CPU; only tensors and plain values are unpickled."""
        if not path.exists():
            raise RunError(
                f"no {path.name}", file=self.path, expected="a run folder", do="make one with `spelgen train`"
            )
        require_regular_file(path, RunError)
        expected = "a file of `spelgen train`"
        try:
            _require_unpacked_size(path)
            state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch has no common type of errors for broken files
            raise RunError(f"unreadable ({type(error).__name__})", file=path, expected=expected) from error
        if not isinstance(state, dict):
            raise RunError(type(state).__name__, file=path, expected=expected)
        return state

    def read_spec(self) -> ModelSpec:
        """Return the specification in spec.json. Raises RunError if there is none, ModuleError if it is not valid."""
        if not self.spec.exists():
            if (self.path / "module.py").exists():
                raise RunError(
                    "a run of an earlier version of spelgen", file=self.path, expected=f"a run with {self.spec.name}",
                    do="build the module again with `spelgen build`, and train it again with `spelgen train`",
                )  # fmt: skip
            raise self._no_run(self.spec)
        # the limit of 1 MiB is ten times the size of the largest specification from `spelgen build`
        text = read_bytes(self.spec, ModuleError, "a specification of a model", 2**20)
        return spec_from_json(text.decode("utf-8", "replace"), self.spec)

    def untrained_model(self) -> ArmModel:
        """Return the model with its initial weights. Raises RunError or ModuleError."""
        return assemble(self.read_spec())


def _require_unpacked_size(path: Path) -> None:
    """Raise ValueError if the unpacked file is too large: torch allocates memory of the sizes that the file states."""
    with ZipFile(path) as archive:
        size = sum(member.file_size for member in archive.infolist())
    # The limit of 512 MiB is far more than a checkpoint with the state of an optimizer has.
    if size > 2**29:
        raise ValueError(f"{size} bytes, expected at most {2**29}")


def _require_finite(weights: Content, path: Path) -> None:
    """Raise RunError if a weight is not finite: all results of the model would be NaN."""
    for name, tensor in weights.items():
        if not isinstance(tensor, Tensor):
            continue
        stored = tensor.untyped_storage()
        # A tensor of a huge shape may repeat a few stored numbers: only the stored numbers are tested.
        if tensor.numel() * tensor.element_size() > stored.nbytes():
            tensor = tensor.new_empty(0).set_(stored)
        # All weights are finite except `servo.limit`, which is infinite for a servo without an effort limit.
        if tensor.isnan().any() or (name != "servo.limit" and tensor.isinf().any()):
            do = "start a new run"
            raise RunError("no finite numbers", file=path, element=name, expected="weights", do=do)


def write_state(path: Path, state: Content) -> None:
    """Write a state in the format of torch.save, completely or not at all."""
    # The state is serialized in memory first: an interruption does not change the existing file.
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_bytes(path, buffer.getvalue())


def fitted_model(run: RunFolder) -> ArmModel:
    """Return the model of a run with its best weights. Raises RunError or ModuleError."""
    model = run.untrained_model()
    weights = run.load_state(run.weights)
    _require_finite(weights, run.weights)
    try:
        model.load_state_dict(weights)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise RunError("weights of another model", file=run.weights, do="start a new run") from error
    return model
