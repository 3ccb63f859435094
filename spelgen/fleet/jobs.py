"""One run of a fleet: a module trained on its arm's logs and judged on its test logs, with a folder of its own."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from spelgen import __version__, pipeline
from spelgen.baselines.keep import keep_baseline
from spelgen.dynamics.protocol import has_rigid_bodies
from spelgen.evaluation.evaluate import evaluate
from spelgen.evaluation.subject import read_test_logs
from spelgen.files import write_json, write_text
from spelgen.fitting.fitted import load_run
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.stages import default_config
from spelgen.fitting.train import train
from spelgen.loaded_arm import load_arm
from spelgen.logs.preprocessing import Preprocessing
from spelgen.settings.fits import FitConfig, GaussianPrior, fit_config
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.settings import load_settings
from spelgen.settings.training import TrainingSettings

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


@dataclass(frozen=True)
class Job:
    """A run. robot, preset, seed, split: what it is called in the report; `folder`: of the run. data: digest of the
    logs. joints, tip, width, depth: of its module. training: over the settings beside the URDF. source: a run whose
    weights it starts from, prior: how far it may go from these. judged: on test logs; if not, by validation alone.
    """

    robot: str
    preset: str
    seed: int
    split: int
    folder: Path
    urdf: Path
    train: tuple[Path, ...]
    test: tuple[Path, ...]
    data: str
    mapping: LogMapping = field(default_factory=LogMapping)
    joints: tuple[str, ...] | None = None
    tip: str | None = None
    design: str = ""  # the preset; of one with a label of its own
    width: int = 64
    depth: int = 2
    training: TrainingSettings = field(default_factory=TrainingSettings)
    source: Path | None = None
    prior: GaussianPrior | None = None
    device: str = "cpu"
    judged: bool = True

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.robot}, {self.preset}, seed {self.seed}" + (
            f", split {self.split}" if self.split else ""
        )

    @property
    def key(self) -> str:
        """Of all that its result follows from."""
        own = Path(self.design)
        design = own.read_text(encoding="utf-8") if own.suffix else self.design
        parts = {
            **asdict(self),
            "design": design,
            "version": __version__,
            "folder": "",
            "train": "",
            "test": "",
        }
        for name in ("mapping", "training", "prior"):
            value = getattr(self, name)
            parts[name] = None if value is None else value.model_dump(mode="json", exclude_unset=True)
        return hashlib.sha256(json.dumps(parts, default=str, sort_keys=True).encode()).hexdigest()[:16]

    def result(self) -> dict[str, Any] | None:
        """What this very job found, where it has ended."""
        path = self.folder / "result.json"
        found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        return found if found.get("key") == self.key else None


def with_options(job: Job, options: Mapping[str, Any]) -> Job:
    """The job with other options of training, width and depth."""
    own = {name: value for name, value in options.items() if name in ("width", "depth")}
    rest = {name: value for name, value in options.items() if name not in ("width", "depth")}
    return replace(job, training=job.training.model_copy(update=rest), **own)


def run_job(job: Job) -> dict[str, Any]:
    """Train and judge, or go on where that was stopped; the result, which result.json then holds too.

    Raises what `train` and `evaluate` raise, and KeyboardInterrupt when it was told to end.
    """
    done = job.result()
    if done is not None:
        return done
    torch.set_num_threads(1)
    began, run = time.monotonic(), RunFolder(job.folder)
    _require_own(job, run)
    resume = run.config.exists()
    ended = train(
        run.module if resume else _module(job), job.train, job.folder, None if resume else _config(job),
        urdf=None if resume else job.urdf, source=job.source, mapping=job.mapping,
        preprocessing=_preprocessing(job), validation=_training(job).validation_fraction, seed=job.seed,
        resume=resume, force=not resume, device=job.device, progress=False,
    )  # fmt: skip
    if ended.status == "interrupted":
        raise KeyboardInterrupt
    result = {
        "key": job.key, "robot": job.robot, "preset": job.preset, "seed": job.seed, "split": job.split,
        "status": ended.status, "parameters": ended.parameters, "validation": ended.best_validation,
    } | (_judged(job, run) if job.judged else {})  # fmt: skip
    result["seconds"] = time.monotonic() - began
    write_json(job.folder / "result.json", result)
    return result


def _require_own(job: Job, run: RunFolder) -> None:
    """Take away another job's run, one of other settings for example."""
    owner = job.folder / "job.json"
    if owner.is_file() and json.loads(owner.read_text(encoding="utf-8")) == {"key": job.key}:
        return
    run.config.unlink(missing_ok=True)  # what makes it a run
    write_json(owner, {"key": job.key})


def _module(job: Job) -> Path:
    """The module of the job's arm and preset, written where it is not there yet."""
    path = job.folder / "built.py"
    arm = load_arm(job.urdf, job.joints, job.tip)
    return write_text(
        path, pipeline.generate(arm, job.design or job.preset, width=job.width, depth=job.depth)
    )


def _training(job: Job) -> TrainingSettings:
    """What the robot's settings say, and the fleet's over them."""
    said = job.training.model_fields_set
    return load_settings(job.urdf).training.model_copy(
        update={name: getattr(job.training, name) for name in said}
    )


def _preprocessing(job: Job) -> Preprocessing:
    return Preprocessing(**_training(job).preprocessing)


def _config(job: Job) -> Any:
    """A `Choice` of `train`: the objective that is asked for or that suits the model; of the options, those of it."""
    said = _training(job)

    def config(model: EmittedModel, rates: Sequence[float] | None) -> FitConfig | None:
        rigid_bodies = has_rigid_bodies(model)
        own = {} if job.prior is None else {"prior": job.prior}
        if said.objective is not None and not (rigid_bodies and said.objective == "momentum"):
            return fit_config(said.objective, rigid_bodies=rigid_bodies, options=own, defaults=said.options)
        if rates is None and rigid_bodies:
            return None  # the logs decide
        return default_config(model, rates or [], own, said.options)

    return config


def _judged(job: Job, run: RunFolder) -> dict[str, Any]:
    """Errors on the test logs, of the model and the URDF; evaluation.json has all of them.

    Least squares is left out: its stiff rollouts take ten times as long as all else, for every run anew.
    """
    keep_baseline(run.path, job.train)
    logs = read_test_logs(job.folder, job.test, job.mapping)
    found = evaluate(load_run(job.folder), logs).to_dict()
    write_json(run.evaluation, found)
    return {
        "errors": {
            horizon["name"]: {name: each["mean_relative_rms"] for name, each in horizon["errors"].items()}
            for horizon in found["horizons"]
        },
        "torque": {name: each["mean_nmse"] for name, each in found["torque"].items()},
    }
