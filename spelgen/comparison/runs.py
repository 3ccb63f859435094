"""The runs of a comparison: train and measure what is not yet done."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

import torch

from spelgen.baselines.names import MODEL
from spelgen.baselines.predictor import of_dynamics
from spelgen.comparison.metrics import predict, sizes, step_seconds, thinned
from spelgen.comparison.study import Study, Variant
from spelgen.comparison.truth import example_positions, mass_error, true_mass
from spelgen.emission.loading import load_module
from spelgen.evaluation.examples import predict_examples
from spelgen.evaluation.invariants import invariants
from spelgen.files import write_json
from spelgen.fitting.fit import RunOptions
from spelgen.fitting.rollout import LossScales, loss_scales
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.fitting.train import train
from spelgen.fleet.tasks import RunTasks
from spelgen.logs.read import read_logs
from spelgen.settings.fits import BATCH, Rollout
from spelgen.spec import read_facts

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

HORIZON = 1.0  # s, over which trajectories are predicted


def run_study(study: Study, run_tasks: RunTasks, *, note: Callable[[str], None]) -> None:
    """Train and measure what is not yet done; `note` hears of each run that ends. What a run raises ends all."""
    waiting = [
        (variant, seed)
        for seed in range(study.settings.seeds)
        for variant in study.variants
        if not study.result(variant, seed).exists()
    ]
    count = len(study.variants) * study.settings.seeds
    done = count - len(waiting)
    if done:
        note(f"{done} of {count} runs are done already")
    for (variant, seed), result in run_tasks(partial(_run, study), waiting):
        if isinstance(result, Exception):
            raise result
        done += 1
        loss = result["prediction"]["loss"]
        shown = "not finite" if loss is None else f"{loss:.3g}"
        took = f"{result['seconds']:.0f} s"
        note(f"{done}/{count} {variant.name}, seed {seed}: prediction loss {shown}, {took}")


def _run(study: Study, chosen: tuple[Variant, int]) -> dict[str, Any]:
    """Train one variant with one seed, or go on where it was stopped, and measure it."""
    variant, seed = chosen
    folder = study.run(variant, seed)
    run = RunFolder(folder)
    resume = run.checkpoint.exists()
    ended = train(
        study.module(variant), [study.logs], folder, study.training, preprocessing=study.preprocessing,
        validation=study.validation_fraction, seed=seed, urdf=study.urdf,
        options=RunOptions(resume=resume, force=not resume),
    )  # fmt: skip
    if ended.status == "interrupted":
        raise KeyboardInterrupt
    found = _measured(study, trained_model(run), read_facts(run.module).joints, ended.substeps)
    result = {
        "variant": variant.name,
        "seed": seed,
        "seconds": ended.seconds,
        "substeps": ended.substeps,
        **found,
    }
    write_json(study.result(variant, seed), result)
    return result


def _measured(study: Study, model: EmittedModel, joints: Sequence[str], substeps: int) -> dict[str, Any]:
    """What result.json holds of a trained model."""
    decimation = study.preprocessing.decimation or 1
    training, testing = (read_logs([study.logs], joints, role=role) for role in ("train", "test"))
    steps = round(HORIZON / (decimation * float(testing[0].t[1] - testing[0].t[0])))
    far = thinned(testing, steps + 1, decimation)
    near_train, near_test = (thinned(x, study.window, decimation) for x in (training, testing))
    low, high = (torch.tensor(x, dtype=torch.float64) for x in (study.low, study.high))
    examples = predict_examples(
        of_dynamics(MODEL, model, substeps), testing, steps, joints, decimation=decimation, measured=False
    )
    along = example_positions(asdict(examples[0])) if examples else torch.zeros(0, len(joints))
    seen = far.q[:, 0]
    return {
        "sizes": asdict(sizes(model)),
        "train": asdict(predict(model, near_train, substeps)),
        "test": asdict(predict(model, near_test, substeps)),
        "prediction": asdict(predict(model, far, substeps)),
        "invariants": asdict(invariants(model, far, low, high)),
        "mass": {
            "error": mass_error(model.mass_matrix(seen), true_mass(study.source, seen)),
            "along": model.mass_matrix(along).tolist(),
        },
        "examples": [asdict(x) for x in examples],
    }


def time_steps(study: Study) -> dict[str, float]:
    """Seconds of a training step of each variant, one after the other in this process."""
    joints = read_facts(study.module(study.variants[0])).joints
    training = read_logs([study.logs], joints, role="train")
    windows = thinned(training, study.window, study.preprocessing.decimation or 1)
    windows = windows[: (study.training or Rollout()).batch or BATCH]
    times = {}
    torch.set_num_threads(1)
    for variant in study.variants:
        model = load_module(study.module(variant))
        scales: LossScales = loss_scales(windows, model.joint_types)
        times[variant.name] = step_seconds(model, windows, scales, 1)
    return times
