"""Switch off each mechanism of the torque fits, one after the other, and print the change of the error.

    python benchmarks/ablation.py [--recordings FOLDER] [--arms-folder URDFS] [--only NAME] [--case NAME]

Cases, each fitted with `hybrid`: the documented splits of recordings (docs/real_logs.md), trained on the first 3 s and
on all training recordings; a simulated UR10e with springs, gear ripple or uneven friction (benchmarks/arms.py); and
simulated arms of benchmarks/truth.py, one of them with the errors of real arms and sensors (`real_errors.py`). The
error is the torque nMSE on test motions, and for all arms of truth.py also the relative error of M(q). A cell is the
relative change of the error without the mechanism, in per cent: +5.0 means that the mechanism lowers the error. A
mechanism below 2 % in all cells, and without a test of a failure that it prevents, is to be removed.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))

import arms
import truth
from leaderboard import duration_name, folds
from real_errors import draw_errors
from real_logs import mean, samples_of, torque_of, trained
from recordings import folder_of

import spelgen
from spelgen.dynamics.parameters import residual_torque
from spelgen.fitting.torque import fit as torque_fit
from spelgen.fitting.torque import joint_functions, stages
from spelgen.fitting.torque import parameters as torque_prior
from spelgen.fitting.torque import problem as torque_problem
from spelgen.fitting.torque.fit import fit_torque
from spelgen.fitting.torque.linearization import RigidProjection
from spelgen.fitting.torque.tuning import SELECTION, TUNING
from spelgen.fitting.tuning import TUNING as DAMPING

NEVER = float("inf")
SIMULATED = (
    truth.PANDA,
    replace(truth.PANDA, number=1_000_001, friction="bristles", seconds=20.0),
    replace(
        truth.PANDA, number=1_000_002, arm="random", friction="stribeck", urdf_error=np.inf, seconds=20.0
    ),
    replace(truth.PANDA, number=118, arm="realman_rm_75", springs=True, seconds=10.0),
    # an arm whose wrist joints carry no gravity load
    replace(truth.PANDA, number=1_000_004, arm="niryo_ned3pro", friction="load"),
    replace(
        truth.PANDA, number=1_000_005, seconds=20.0, errors=draw_errors(np.random.default_rng(1_000_005))
    ),
)


ESTIMATE = torque_problem.NoiseEstimator.estimate
OWN_BRISTLES = {kind: shared for kind, shared in torque_prior.SHARED.items() if kind != "fractions"}


@dataclass(frozen=True)
class Mechanism:
    """A mechanism of the torque fit; switches: (module, attribute, value), where the value disables the mechanism."""

    name: str
    switches: tuple[tuple[Any, str, Any], ...]


def tuned(table: Any, **changes: Any) -> tuple[tuple[Any, str, Any], ...]:
    """Return switches (module, attribute, value) that change constants of `table` in all modules that import it."""
    changed = replace(table, **changes)
    readers = [x for name, x in sys.modules.items() if name.startswith("spelgen.")]
    return tuple(
        (reader, name, changed) for reader in readers for name, x in vars(reader).items() if x is table
    )


def keep_prior(prior: Any, *_: Any) -> Any:
    """Substitute for `update_widths`: return the prior unchanged; its standard deviations keep their initial values."""
    return prior


def keep_armatures(prior: Any, *estimate: Any) -> Any:
    """Substitute for `update_widths`: the prior standard deviation of the armatures keeps its initial value."""
    updated = torque_prior.update_widths(prior, *estimate)
    widths = updated.widths.model_copy(update={"armature": prior.widths.armature})
    return replace(updated, widths=widths)


def one_body_width(prior: Any, *estimate: Any) -> Any:
    """Substitute for `update_widths`: all bodies share one prior standard deviation, instead of one per body."""
    updated = torque_prior.update_widths(prior, *estimate)
    return replace(updated, body_widths=torch.full_like(updated.body_widths, updated.widths.bodies))


def no_freedom(estimator: Any, squared_residual: Any, *_: Any) -> Any:
    """Substitute for `NoiseEstimator.estimate`: noise without correction for the number of fitted parameters."""
    return ESTIMATE(estimator, squared_residual)


def always_hysteretic(estimate: Any) -> Any:
    """Substitute for `choose_friction_state`: return the fit in which friction of every joint has bristle states.

    estimate: fit with rate-only friction, a `TorqueEstimate`; it is refitted with bristles.
    """
    estimate.problem.jacobian.model.friction.memoryless.fill_(0.0)
    problem, state = stages._least_squares_noise_fit(estimate.problem, estimate.state)
    return torque_problem.alternate(problem, state)


def keep_all(estimate: Any) -> Any:
    """Substitute for `choose_friction_effects`: friction has all effects at every joint."""
    return estimate


def no_occam_factor(estimate: Any) -> float:
    """Return a log Occam factor of 0 in place of `fraction_occam_factor`: only likelihoods choose friction states."""
    return 0.0


def no_limit(model: Any, samples: Any) -> None:
    """Substitute for `limit_friction`: nominal friction depends on effort limits only, not on the measured torque."""


def not_orthogonalized(projection: Any, joint: int, torque: Any) -> Any:
    """Substitute for `orthogonalize`: a residual term keeps the part of its torque that rigid bodies could absorb."""
    return torque


def alternately(model: Any, samples: Any, *rest: Any) -> joint_functions.ProjectedTerms:
    """Substitute for `refit_terms`: residual terms and rigid bodies are fitted alternately, not simultaneously.

    `refit_terms` has the same arguments. The weights of all terms are written to the model; the result has no linear
    terms, so that the next fit of the rigid bodies does not change these weights.
    """
    with torch.no_grad():
        torque = residual_torque(model, *samples[:3])
        projected = joint_functions.refit_terms(model, samples, *rest)
        torque = torque - residual_torque(model, *samples[:3])
    projected.write(model, samples.torque_residual + torque)
    return joint_functions.ProjectedTerms({}, ())


def mechanisms() -> list[Mechanism]:
    """Return all mechanisms of the torque fit that the ablation disables, one at a time."""
    return [
        Mechanism("correlated errors", tuned(TUNING, correlation_time=0.02, correlation_weight=NEVER)),
        Mechanism("correlation time from the data", tuned(TUNING, correlation_weight=NEVER)),
        Mechanism("shorter correlation at reversals", tuned(TUNING, reversal_correlation_time=0.2)),
        Mechanism("bounded prior widths", tuned(TUNING, max_width=NEVER)),
        Mechanism("steps at the least-squares noise", tuned(TUNING, initial_steps=0)),
        Mechanism("noise annealing", tuned(TUNING, annealing_iterations=0)),
        Mechanism("more iterations if noise decreases", tuned(TUNING, noise_converged=0.0)),
        Mechanism("estimated prior widths", ((torque_problem, "update_widths", keep_prior),)),
        Mechanism("estimated prior width of armatures", ((torque_problem, "update_widths", keep_armatures),)),
        Mechanism("prior width per link", ((torque_problem, "update_widths", one_body_width),)),
        Mechanism("friction state by evidence", ((torque_fit, "choose_friction_state", always_hysteretic),)),
        Mechanism(
            "Occam factor of bristle fractions",
            ((stages, "fraction_occam_factor", no_occam_factor),),
        ),
        Mechanism("weak evidence yields to all joints", tuned(TUNING, strong_evidence=0.0)),
        Mechanism("friction effects by evidence", ((torque_fit, "choose_friction_effects", keep_all),)),
        Mechanism("common factor of bristle fractions", ((torque_prior, "SHARED", OWN_BRISTLES),)),
        Mechanism(
            "degrees of freedom of the noise", ((torque_problem.NoiseEstimator, "estimate", no_freedom),)
        ),
        Mechanism("friction limited to the torque", ((torque_fit, "limit_friction", no_limit),)),
        Mechanism("friction compensation of drives", tuned(TUNING, min_significance=NEVER)),
        Mechanism("every second sample", tuned(TUNING, decimation=1)),
        Mechanism("subset of samples first", tuned(TUNING, initial_samples=2**40)),
        Mechanism("steps in inertial parameters", tuned(DAMPING, min_gain_ratio=-NEVER)),
        Mechanism("alternations with residual terms", tuned(TUNING, alternations=1)),
        Mechanism("variable projection", ((stages, "refit_terms", alternately),)),
        Mechanism("residual terms", tuned(SELECTION, standard_errors=NEVER)),
        Mechanism("orthogonalization of terms", ((RigidProjection, "orthogonalize", not_orthogonalized),)),
        Mechanism("significance of residual terms", tuned(SELECTION, standard_errors=0.0)),
        Mechanism("strong evidence from one recording", tuned(SELECTION, standard_errors_of_one=2.82)),
        Mechanism(
            "plausible torques of one recording",
            tuned(SELECTION, max_torque_fraction=NEVER, min_load_fraction=0.0),
        ),
        Mechanism("gaps between blocks", tuned(SELECTION, gap=0.0)),
        Mechanism("minimum error reduction", tuned(SELECTION, min_reduction=0.0)),
        Mechanism("networks in residual terms", ((stages, "select_networks", lambda *_: iter(())),)),
    ]


@contextlib.contextmanager
def switched_off(mechanism: Mechanism | None) -> Iterator[None]:
    """Context in which a mechanism of the torque fit is disabled; with None nothing is replaced."""
    with contextlib.ExitStack() as stack:
        for module, name, value in mechanism.switches if mechanism else ():
            stack.callback(setattr, module, name, getattr(module, name))
            setattr(module, name, value)
        yield


def real_cases(folder: Path) -> Iterator[tuple[str, Callable[[], dict[str, float]]]]:
    """Yield two cases per documented split: fits to the first 3 s in total, and to all of the training recordings.

    A case is its name, such as "ur10e, 3 s", and a function that fits `hybrid` and returns {"nMSE": test error}.
    """
    for fold in folds(folder):
        if "/split" in fold.name:
            tests = next(iter(fold.tests.values()))
            for seconds in (3.0, np.inf):
                name = f"{fold.name.removesuffix('/split')}, {duration_name(seconds)} s"
                yield name.replace("all s", "all"), fit_and_judge(fold.urdf, fold.first(seconds), tests)


def fit_and_judge(urdf: Path, training: Any, tests: Any) -> Callable[[], dict[str, float]]:
    """Return a function that fits `hybrid` to the training recordings and returns its torque nMSE on the tests."""

    def run() -> dict[str, float]:
        fit = trained(urdf, training, "hybrid")
        return {"nMSE": mean(torque_of(fit.model), samples_of(fit, tests, pauses=True))}

    return run


def simulated_cases(folder: Path) -> Iterator[tuple[str, Callable[[], dict[str, float]]]]:
    """Yield a case per simulated arm of `SIMULATED`: its name, and a function that fits `hybrid` to its logs.

    The function returns {"nMSE": torque error, "M": relative error of M}. Arms without a URDF in `folder` are omitted.
    """
    for case in SIMULATED:
        if case.arm != "random" and not (folder / f"{case.arm}.urdf").exists():
            continue
        springs = ", springs" * case.springs + ", real errors" * (case.errors is not None)
        yield f"{case.arm}, {case.friction}{springs}", lambda case=case: fit_truth(case, folder)


def effect_cases() -> Iterator[tuple[str, Callable[[], dict[str, float]]]]:
    """Yield a case per effect in a simulated UR10e (springs, gear ripple, uneven friction), and one with all effects.

    A case is its name, and a function that fits `hybrid` and returns {"nMSE": torque error on a test motion}.
    """
    for effect, logs, test in arms.with_effects():

        def run(logs: Any = logs, test: Any = test) -> dict[str, float]:
            model = spelgen.build(arms.ROBOT, "hybrid")
            fit_torque(model, logs)
            return {"nMSE": mean(torque_of(model), [test])}

        yield f"simulated UR10e, {effect}", run


def fit_truth(case: truth.Case, folder: Path) -> dict[str, float]:
    """Simulate the arm of a case, fit `hybrid` to its logs, and return the torque nMSE and the relative error of M."""
    rng = np.random.default_rng([case.number, 1])
    with tempfile.TemporaryDirectory() as temporary:
        given, urdf = Path(temporary) / "given.urdf", folder / f"{case.arm}.urdf"
        if case.arm == "random":
            urdf = Path(temporary) / "random.urdf"
            urdf.write_bytes(truth.random_arm(rng))
        given.write_bytes(truth.wrong_urdf(urdf, case.urdf_error, rng))
        arm = truth.Truth(case, urdf, rng)
        logs = truth.record_log(arm, case, rng)
        test = truth.fourier_motion(arm, 10.0, rng)
        model = truth.fit_hybrid(given, logs)
        errors = truth.measure(model, arm, test)
    return {"nMSE": errors["nmse"], "M": errors["mass"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recordings", type=Path, help="folder of benchmarks/recordings.py")
    parser.add_argument("--arms-folder", type=Path, default=truth.ARMS, help="URDFs of the simulated arms")
    parser.add_argument("--only", default="", help="mechanisms whose names hold this")
    parser.add_argument("--case", default="", help="robots whose names hold this")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    chosen = [each for each in mechanisms() if options.only in each.name]
    recordings = folder_of(options.recordings)
    cases = [*real_cases(recordings), *effect_cases(), *simulated_cases(options.arms_folder)]
    for name, run in cases:
        if options.case not in name:
            continue
        reference = run()
        shown = ", ".join(f"{key} {value:.6f}" for key, value in reference.items())
        print(f"\n{name}: {shown}", flush=True)
        for mechanism in chosen:
            with switched_off(mechanism):
                errors = run()
            worth = "".join(f"{100 * (errors[key] / reference[key] - 1):+10.1f}" for key in reference)
            print(f"  {mechanism.name:34}{worth}", flush=True)


if __name__ == "__main__":
    main()
