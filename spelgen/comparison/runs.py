"""The runs of a comparison: train and measure what is not yet done."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

import torch

from spelgen.baselines.predictor import Predictor, of_dynamics
from spelgen.comparison.metrics import (
    RunResult,
    mass_error,
    predict,
    sizes,
    thinned,
    true_mass,
)
from spelgen.comparison.study import Study, Variant
from spelgen.comparison.tuning import TUNING
from spelgen.emission.loading import load_module
from spelgen.evaluation.drawn_motions import PredictedMotion, predicted_motion
from spelgen.evaluation.invariants import invariants
from spelgen.evaluation.plain import array, listed
from spelgen.fitting.fit import RunOptions
from spelgen.fitting.rollout import loss_scales, rollout_loss
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.fitting.train import train
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import cut_windows
from spelgen.pipeline.loaded_arm import load_arm
from spelgen.settings.fits import DEFAULTS, Rollout
from spelgen.structure.nominal import working_range
from spelgen.tasks import RunTasks


def run_study(study: Study, run_tasks: RunTasks, *, note: Callable[[str], None]) -> None:
    """Train and measure what is not yet done; `note` hears of each run that ends. What a run raises ends all."""
    # seed by seed: a comparison that is stopped has all variants of the first seeds
    tasks = list(product(range(study.settings.seeds), study.variants))
    waiting = []
    for seed, variant in tasks:
        if not study.result(variant, seed).exists():
            waiting.append((variant, seed))
    done = len(tasks) - len(waiting)
    if done:
        note(f"{done} of {len(tasks)} runs are done already")
    for (variant, seed), result in run_tasks(partial(_run, study), waiting):
        if isinstance(result, Exception):
            raise result
        done += 1
        loss = "not finite" if result.prediction.loss is None else f"{result.prediction.loss:.3g}"
        heading = f"{done}/{len(tasks)} {variant.name}, seed {seed}"
        note(f"{heading}: prediction loss {loss}, {result.seconds:.0f} s")


def _run(study: Study, task: tuple[Variant, int]) -> RunResult:
    """Train one variant with one seed, or go on where it was stopped, and measure it."""
    variant, seed = task
    run = RunFolder(study.run(variant, seed))
    resume = run.checkpoint.exists()
    fit = train(
        study.module(variant), [study.logs], run.path, study.training, preprocessing=study.preprocessing,
        validation=study.validation_fraction, seed=seed, urdf=study.urdf,
        options=RunOptions(resume=resume, force=not resume),
    )  # fmt: skip
    if fit.status == "interrupted":
        raise KeyboardInterrupt
    model = trained_model(run)
    decimation, training, testing = study.decimation, study.read_logs("train"), study.read_logs("test")
    steps = round(TUNING.horizon / (decimation * float(testing[0].t[1] - testing[0].t[0])))
    far = thinned(testing, steps + 1, decimation)
    # M is looked at where the arm may be, and judged where it has been
    ranges = list(map(working_range, load_arm(study.source).arm.coordinates))
    low, high = torch.tensor(ranges, dtype=torch.float64).T
    seen = far.q[:, 0]
    example = predict_example(of_dynamics(variant.name, model, far), testing, steps, decimation)
    along = []  # no test trajectory may be long enough
    if example is not None:
        # at the positions as the file has them
        along = model.mass_matrix(torch.from_numpy(array(listed(example.q)))).tolist()
    result = RunResult(
        variant=variant.name,
        seed=seed,
        seconds=fit.seconds,
        substeps=fit.substeps,
        sizes=sizes(model),
        train=predict(model, thinned(training, study.window, decimation), fit.substeps),
        test=predict(model, thinned(testing, study.window, decimation), fit.substeps),
        prediction=predict(model, far, fit.substeps),
        invariants=invariants(model, far, low, high),
        mass_error=mass_error(model.mass_matrix(seen), true_mass(study.source, seen)),
        mass=along,
        example=example,
    )
    result.save(study.result(variant, seed))
    return result


def predict_example(
    predictor: Predictor, logs: Sequence[Trajectory], steps: int, decimation: int
) -> PredictedMotion | None:
    """Predict `steps` steps of `decimation` samples in the middle of the first log that is long enough."""
    span = steps * decimation
    for log in logs:
        if len(log) > span:
            # a multiple of the decimation: the controller holds its torque so long
            start = (len(log) - 1 - span) // (2 * decimation) * decimation
            piece = log[start : start + span + 1]
            window = cut_windows([piece], steps + 1, decimation=decimation, measured=False)
            return predicted_motion(log.name, window, predictor.solver(window))
    return None


def time_steps(study: Study) -> dict[str, float]:
    """Return by variant the median time of a training step, without the update of the weights [s]."""
    windows = thinned(study.read_logs("train"), study.window, study.decimation)
    windows = windows[: (study.training or Rollout()).batch or DEFAULTS.batch]
    times = {}
    torch.set_num_threads(1)
    for variant in study.variants:
        model = load_module(study.module(variant))
        scales = loss_scales(windows, model.joint_types)
        durations = []
        # the median: other programs run beside
        for _ in range(TUNING.timed_steps):
            start = time.perf_counter()
            model.zero_grad()
            torch.autograd.backward(rollout_loss(model, windows, scales, 1))
            durations.append(time.perf_counter() - start)
        times[variant.name] = statistics.median(durations)
    return times
