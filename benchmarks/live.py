"""Payload, friction and contact estimates of the live estimator on recordings: all numbers of docs/live.md.

    python benchmarks/live.py [FOLDER] [--arms ur10e panda ...] [--runs FOLDER]

FOLDER is made by `python benchmarks/recordings.py FOLDER`, by default runs/recordings. Each arm is fitted to its
training logs by the defaults of spelgen (preset hybrid), the noise levels are found by cross-validation, and the
exported C estimator, which equals the Python estimator (tests/test_live_c.py), runs along the other logs. Payloads
and contacts are added to measured torques.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from compiled_estimator import Columns, CompiledEstimator, differences
from real_logs import LOADED, OUTSIDE, TESTS, TRAINING, after, first
from recordings import folder_of, panda_urdf

import spelgen
from spelgen.dynamics.body_regressor import chain_regressor
from spelgen.dynamics.bristles import bristle_reach
from spelgen.emission.specify import arm_of_spec
from spelgen.evaluation.torque import mean_nmse, predicted_torques
from spelgen.fitting.fitted import Fit
from spelgen.live.estimator import torque_model
from spelgen.live.levels import held_out, noise_levels
from spelgen.live.noise import NoiseLevels
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples, is_moving
from spelgen.logs.filtering import low_passed
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory

AIRBOT = ("ps_N7T25QR-5", "ps_N7T25QR-6_again")
MASSES = (0.25, 0.5, 1.0, 2.0, 4.0)
SMALL = {"airbot": 0.25}
"""Factor on synthetic payloads of small arms."""
PAYLOAD = 2
"""Status of a found payload, in C."""


@dataclass(frozen=True, eq=False)
class Case:
    """An arm: its fit, the noise levels of its estimator, and logs that are not in the training.

    tests: logs without a load, to which simulated payloads and contacts are added. others: logs with a load or under
    other conditions.
    """

    name: str
    fit: Fit
    levels: NoiseLevels
    tests: list[Trajectory]
    others: list[Trajectory]

    @cached_property
    def compiled(self) -> CompiledEstimator:
        """The exported C estimator of the fitted model, compiled."""
        assert self.fit.urdf is not None
        return CompiledEstimator(self.fit.model, arm_of_spec(self.fit.model.spec, self.fit.urdf), self.levels)

    def run(self, log: Trajectory, tau: np.ndarray | None = None) -> Columns:
        """Return the outputs of a restarted C estimator along a log; tau: (T, n) torques in place of the log's."""
        self.compiled.start()
        return self.compiled.run(log.t, log.q, log.qd, log.tau if tau is None else tau)

    def samples(self, log: Trajectory, *, pauses: bool = False) -> DynamicsSamples | None:
        """Return the filtered samples of a log, for comparisons of torques; None if there are 50 or fewer.

        pauses: if True, samples at standstill between motions are included.
        """
        reach = bristle_reach(self.fit.model)
        found = dynamics_samples([log], pauses=pauses, preprocessing=self.fit.preprocessing, reach=reach)
        return found[0] if found and len(found[0].q) > 50 else None

    def load(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return the torque of a payload, (T, n) [Nm], along a motion (T, n); theta: (10,), last joint's frame."""
        # the payload moves with the last body, whose ten columns are the last of the regressor
        return chain_regressor(torque_model(self.fit).chain, q, qd, qdd)[..., -10:] @ theta

    def loaded(self, log: Trajectory, theta: np.ndarray) -> np.ndarray:
        """Return the torques of a log plus the torques of a payload theta (10,), (T, n) [Nm].

        Accelerations are differences of the velocities after a low-pass of 8 Hz.
        """
        qd = low_passed(log.t, log.qd, 8.0) if log.sample_rate > 17 else log.qd
        return log.tau + self.load(log.q, log.qd, np.gradient(qd, log.t, axis=0), theta)


def payload(mass: float, random: np.random.Generator) -> np.ndarray:
    """Return the inertial parameters (10,) of a homogeneous ball at a random offset from the last joint's frame."""
    center = np.array([*random.uniform(-0.08, 0.08, 2), random.uniform(0.0, 0.15)])
    radius = 0.05 * max(mass, 0.1) ** (1 / 3)
    inertia = 0.4 * mass * radius**2 * np.eye(3) + mass * (
        center @ center * np.eye(3) - np.outer(center, center)
    )
    return np.array([mass, *(mass * center), *inertia[np.triu_indices(3)]])


def moved(columns: Columns, seconds: float) -> int:
    """Return the first row of the estimator's outputs at which the arm has moved for `seconds` seconds in total."""
    return int(np.searchsorted(columns.moved, seconds))


def real_loads(case: Case) -> None:
    print("\nReal loads: nMSE of the rest of the log, mass [kg] and its interval\n")
    print(f"{'':26}{'after':>7}{'fixed':>9}{'with load':>11}{'mass':>8}   interval")
    for log in case.others:
        if log.name not in LOADED:
            continue
        columns = case.run(log)
        for seconds in (2, 5, 10):
            # k: row of the estimate after `seconds` seconds of motion
            k = moved(columns, seconds)
            rest = case.samples(after(log, float(log.t[k] - log.t[0])))
            if rest is None:
                continue
            predicted = predicted_torques(case.fit.model, rest)
            load = case.load(rest.q, rest.qd, rest.qdd, columns.parameters[k])
            fixed, found = (mean_nmse(x - rest.tau, rest.tau) for x in (predicted, predicted + load))
            low, high = columns.mass_interval[k]
            print(
                f"{log.name:26}{seconds:5d} s{fixed:9.4f}{found:11.4f}{columns.mass[k]:8.2f}   {low:.2f} to {high:.2f}"
                f"   log odds {columns.log_odds[k]:.0f}"
            )


def without_load(case: Case) -> None:
    reported = changed = minutes = 0.0
    for log in case.tests:
        columns = case.run(log)
        reported += float((columns.status == PAYLOAD).any())
        changed += columns.changed.sum()
        minutes += log.duration / 60
    print(
        f"\nWithout a load: payload reported in {reported:.0f} of {len(case.tests)} logs, {changed:.0f} changes in "
        f"{minutes:.1f} minutes"
    )


def synthetic_loads(case: Case) -> None:
    scale, draws = SMALL.get(case.name, 1.0), max(3, 12 // len(case.tests))
    print(
        "\nSynthetic payloads: reported, error rms [kg], errors within the interval, median time of the first report\n"
    )
    print(f"{'mass':>8}" + "".join(f"{f'{s} s':>26}" for s in (5, 10)) + f"{'first report':>16}")
    for mass in MASSES:
        random, rows, firsts = np.random.default_rng(0), {5: [], 10: []}, []
        for log in case.tests:
            for _ in range(draws):
                theta = payload(scale * mass, random)
                columns = case.run(log, case.loaded(log, theta))
                found = np.flatnonzero(columns.status == PAYLOAD)
                firsts.append(columns.moved[found[0]] if found.size else np.inf)
                for seconds, rows_of in rows.items():
                    k = min(moved(columns, seconds + 0.5), len(log) - 1)
                    is_found = columns.status[k] == PAYLOAD
                    low, high = columns.mass_interval[k]
                    rows_of.append((is_found, columns.mass[k] - theta[0], low <= theta[0] <= high))
        text = f"{scale * mass:8.3f}"
        for rows_of in rows.values():
            found, error, inside = np.array(rows_of).T
            chosen = found > 0
            rms = np.sqrt(np.mean(error[chosen] ** 2)) if chosen.any() else np.nan
            held = inside[chosen].mean() if chosen.any() else np.nan
            text += f"{found.mean():10.0%}{rms:8.3f}{held:8.0%}"
        print(text + f"{np.median(firsts):14.1f} s")


def corrections(case: Case, log: Trajectory, columns: Columns, ahead: float) -> np.ndarray:
    """Return predictions from the estimates known `ahead` [s] before each sample of a log, (2, T, n).

    The first is the relative change of friction [1], the second the disturbance torque [Nm, N]. The disturbance decays
    during `ahead` with the time constant in `case.levels`. As in the estimator, it is predicted as zero if `ahead`
    exceeds 0.3 s. columns: outputs of the estimator along the log, a row per sample.
    """
    k = np.maximum(np.searchsorted(log.t, log.t - ahead, side="right") - 1, 0)
    scale, disturbance = columns.friction_scale[k] - 1, columns.disturbance[k]
    decay = np.exp(-ahead / case.levels.drift.time_constant) if ahead <= 0.3 else 0.0
    return np.stack([scale, disturbance * decay])


def drift(case: Case) -> None:
    print("\nFriction drift: mean torque nMSE, and the worst ratio to the fixed model of a log\n")
    print(f"{'':14}{'fixed':>10}{'0.1 s ahead':>20}{'1 s ahead':>20}")
    for name, pauses in (("moving", False), ("with pauses", True)):
        rows = []
        for log in case.tests:
            if log.name == OUTSIDE:
                continue
            columns, samples = case.run(log), case.samples(log, pauses=pauses)
            if samples is None:
                continue
            predicted = predicted_torques(case.fit.model, samples)
            friction = friction_of(case, samples)
            row = [mean_nmse(predicted - samples.tau, samples.tau)]
            times = times_of(case, log, samples, pauses)
            for ahead in (0.1, 1.0):
                scale, added = (
                    np.stack([np.interp(times, log.t, x) for x in column.T], axis=1)
                    for column in corrections(case, log, columns, ahead)
                )
                row.append(mean_nmse(predicted + scale * friction + added - samples.tau, samples.tau))
            rows.append(row)
        fixed, near, far = np.array(rows).T
        print(
            f"{name:14}{fixed.mean():10.5f}{near.mean():12.5f}{(near / fixed).max():8.2f}"
            f"{far.mean():12.5f}{(far / fixed).max():8.2f}"
        )


def friction_of(case: Case, samples: DynamicsSamples) -> np.ndarray:
    """Return the friction torque of the fitted model at samples, (T, n) [Nm, N]."""
    model = torque_model(case.fit)
    arrays = [samples.q, samples.qd, *([] if samples.z is None else [samples.z])]
    with torch.no_grad():
        return model.friction_torque(*(torch.from_numpy(np.ascontiguousarray(x)) for x in arrays)).numpy()


def times_of(case: Case, log: Trajectory, samples: DynamicsSamples, pauses: bool) -> np.ndarray:
    """Return the time of each filtered sample of a log, (T,) [s].

    Filtered samples (`case.samples`) have no times, and other rows than the log. A copy of the log that has the time as
    torque is therefore filtered in the same way: the filtered torque is then the time. pauses: True if ``samples``
    include samples at standstill.
    """
    clock = np.repeat(log.t[:, None] - log.t[0], log.q.shape[1], axis=1)
    marked = dataclasses.replace(log, tau=clock)
    same = case.samples(marked, pauses=pauses)
    assert same is not None and len(same.q) == len(samples.q)
    return same.tau[:, 0] + log.t[0]


def contacts(case: Case, theta: np.ndarray | None = None) -> None:
    """Print the rate of false contact alarms, and the share and delay of detected contacts.

    Contacts are added external torques of 0.5 s, every 2 s, at each joint in turn.
    theta: (10,) inertial parameters of a payload, with which the arm moves for 10 s before contacts; None: no payload.
    """
    effort, n = case.levels.effort, len(case.levels.effort)
    alarms = minutes = 0.0
    found: dict[float, list[float]] = {0.1: [], 0.05: []}
    for log in case.tests:
        base = log.tau if theta is None else case.loaded(log, theta)
        quiet = case.run(log, base)
        begin = moved(quiet, 10.0 if theta is not None else 1.0)
        over = (np.abs(quiet.external_torque) > quiet.threshold).any(axis=1)
        times = log.t[begin:][over[begin:]]
        # rows over the threshold within half a second of each other are one alarm
        alarms += len(times) and 1 + (np.diff(times) > 0.5).sum()
        minutes += (log.t[-1] - log.t[min(begin, len(log) - 1)]) / 60
        for fraction, delays in found.items():
            for sign in (1.0, -1.0):
                starts = np.arange(log.t[min(begin, len(log) - 1)] + 0.3, log.t[-1] - 0.6, 2.0)
                added = np.zeros_like(base)
                for k, start in enumerate(starts):
                    added[(log.t >= start) & (log.t < start + 0.5), k % n] = sign * fraction * effort[k % n]
                columns = case.run(log, base - added)
                hit = np.abs(columns.external_torque) > columns.threshold
                for k, start in enumerate(starts):
                    rows = np.flatnonzero((log.t >= start) & (log.t < start + 0.5) & hit[:, k % n])
                    delays.append(log.t[rows[0]] - start if rows.size else np.inf)
    carried = "" if theta is None else f" with a load of {theta[0]:g} kg"
    print(f"\nContacts{carried}: {alarms / minutes:.1f} false alarms a minute")
    for fraction, delays in found.items():
        within = np.array(delays)
        print(
            f"  step of {fraction:.0%} of effort: {np.isfinite(within).mean():.0%} found, "
            f"median {1e3 * np.median(within):.0f} ms, {(within <= 0.15).mean():.0%} within 150 ms"
        )


def linear_bound(case: Case, before: float = 0.3, after: float = 0.15) -> None:
    """Print the share of torque steps that a matched filter detects, per rate of false alarms: a bound of detection.

    A step is 10 % of the joint's effort limit. The filter is the generalised least-squares estimate of a step that
    began `after` [s] ago, from the residuals of the momentum balance since then and during `before` [s] before. Its
    covariance and threshold are estimated from the test logs themselves, so that no linear detector of one joint with
    a constant threshold and this delay detects more. The rate of false alarms is divided equally among the joints.
    """
    model, effort, outputs = torque_model(case.fit), case.levels.effort, []
    for log in case.tests:
        samples = held_out(model, log, case.levels)
        t = np.array([x.t for x in samples])
        torque = np.array([x.at.torque - x.at.friction for x in samples])
        rate = np.diff([x.at.momentum for x in samples], axis=0) / np.diff(t)[:, None]
        outputs.append((t[1:], (torque[1:] + torque[:-1]) / 2 - rate))
    step = float(np.median(np.concatenate([np.diff(t) for t, _ in outputs])))
    minutes = sum(t[-1] - t[0] for t, _ in outputs) / 60
    form = np.repeat([0.0, 1.0], [round(before / step), round(after / step)])
    found = np.zeros((3, len(effort)))
    for joint, limit in enumerate(effort):
        views = [np.lib.stride_tricks.sliding_window_view(e[:, joint], len(form)) for _, e in outputs]
        covariance = sum(view.T @ view for view in views) / sum(map(len, views))
        filtered = np.linalg.solve(
            covariance + 1e-6 * covariance.trace() / len(form) * np.eye(len(form)), form
        )
        estimates = [view @ filtered / (form @ filtered) for view in views]
        peaks = []
        for (t, _), values in zip(outputs, estimates, strict=True):
            ends = np.arange(0.5, t[-1] - t[0], 0.5) + t[0]
            spans = np.split(np.abs(values), np.searchsorted(t[len(form) - 1 :], ends))
            peaks += [span.max() for span in spans if len(span)]
        steps = np.concatenate([np.abs(np.concatenate(estimates) + sign * 0.1 * limit) for sign in (1, -1)])
        for k, alarms in enumerate((1, 5, 20)):
            threshold = np.sort(peaks)[::-1][round(alarms * minutes / len(effort))]
            found[k, joint] = (steps > threshold).mean()
    print("\nMatched filter with known waveform and noise, steps of 10% of effort found within 150 ms")
    for alarms, row in zip((1, 5, 20), found, strict=True):
        print(
            f"  {alarms:2d} alarms a minute: {row.mean():.0%}; by joint " + ", ".join(f"{x:.0%}" for x in row)
        )


def changes(case: Case) -> None:
    """Print the delay to find a payload that appears or disappears in mid-log, and contacts mistaken for a payload."""
    random, delays, taken, trials = np.random.default_rng(1), [], 0, 0
    effort = case.levels.effort
    for log in case.tests:
        start = float(log.t[0] + log.duration / 2)
        at = (log.t >= start).astype(float)[:, None]
        moving = np.concatenate([[0], np.cumsum(np.diff(log.t) * is_moving(log.qd)[1:])])
        for mass in (1.0, 2.0, 4.0):
            theta = payload(mass * SMALL.get(case.name, 1.0), random)
            added = case.loaded(log, theta) - log.tau
            for weight in (at, 1 - at):
                columns = case.run(log, log.tau + weight * added)
                rows = np.flatnonzero((columns.changed > 0) & (log.t >= start))
                delays.append(
                    np.interp(log.t[rows[0]], log.t, moving) - np.interp(start, log.t, moving)
                    if rows.size
                    else np.inf
                )
        for joint in range(min(3, len(effort))):
            touch = ((log.t >= start) & (log.t < start + 2.0)).astype(float)
            columns = case.run(
                log, log.tau + np.outer(touch, 0.1 * effort * (np.arange(len(effort)) == joint))
            )
            taken += int((columns.changed > 0).any() or (columns.status[log.t >= start] == PAYLOAD).any())
            trials += 1
    within = np.array(delays)
    print(
        f"\nChanged load: {(within <= 3).mean():.0%} of {len(within)} found within 3 s of motion, "
        f"median {np.median(within):.1f} s, at worst {within.max():.1f} s; "
        f"{taken} of {trials} contacts of 2 s taken for a load"
    )


def parity(case: Case) -> None:
    """Print the largest difference between the outputs of the C and the Python estimator, over all logs of an arm."""
    estimator, largest, count = spelgen.Estimator(case.fit, levels=case.levels), 0.0, 0
    logs = [*case.fit.logs, *case.tests, *case.others]
    for log in logs:
        estimator.reset()
        found = differences(case.run(log), estimator.replay(log))
        largest, count = max(largest, *found.values()), count + len(log)
    print(f"\nC and Python: {largest:.1e} of the largest value, in {len(logs)} logs with {count} samples")


def report(case: Case) -> None:
    print(f"\n== {case.name}: noise levels from {case.levels.minutes:.1f} minutes of training logs")
    if case.name == "ur10e":
        real_loads(case)
    without_load(case)
    drift(case)
    synthetic_loads(case)
    contacts(case)
    if case.name == "ur10e":
        contacts(case, payload(2.0, np.random.default_rng(0)))
    if case.name == "airbot":
        linear_bound(case)
    changes(case)
    parity(case)


def cases(folder: Path, names: Sequence[str], runs: Path) -> list[Case]:
    """Return the arms with these names, each with a fit to its training logs; fits are kept in the folder `runs`."""
    sources = {
        "ur10e": (folder / "ur10e" / "ur10e.urdf", TRAINING, (*TESTS, OUTSIDE), LOADED, 0.0),
        "panda": (panda_urdf(folder), ("exciting_traj1",), (), (), 12.0),
        "xmate3": (folder / "xmate3" / "xmate3.urdf", ("excit",), (), (), 12.0),
        "ar5": (folder / "ar5" / "ar5.urdf", ("real",), (), (), 36.0),
        "shanghai": (folder / "shanghai" / "shanghai.urdf", ("traj2", "traj3"), ("traj1",), (), 0.0),
        "airbot": (folder / "airbot" / "airbot.urdf", AIRBOT, (), (), 0.0),
    }
    found = []
    for name in names:
        urdf, training, tests, others, split = sources[name]
        joints = spelgen.load_arm(urdf).chain.joint_names
        if name == "airbot":
            repeats = {x.removesuffix("_again") for x in AIRBOT}
            tests = tuple(x.stem for x in sorted((folder / name).glob("*.parquet")))
            tests = tuple(x for x in tests if x.removesuffix("_again") not in repeats)
        read = {
            x: read_logs([folder / name / f"{x}.parquet"], joints)[0] for x in (*training, *tests, *others)
        }
        logs, held_out = [read[x] for x in training], [read[x] for x in tests]
        if split:
            held_out, logs = [after(logs[0], split)], [first(logs[0], split)]
        place = runs / name
        if not (place / "config.json").exists():
            spelgen.fit(spelgen.build(urdf, "hybrid"), logs, arm=urdf, folder=place)
        fit = dataclasses.replace(spelgen.load_run(place), logs=logs)
        found.append(Case(name, fit, noise_levels(fit), held_out, [read[x] for x in others]))
    return found


def main() -> None:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", nargs="?")
    parser.add_argument(
        "--arms", nargs="+", default=["ur10e", "panda", "xmate3", "ar5", "shanghai", "airbot"]
    )
    parser.add_argument("--runs", type=Path, default=Path("runs") / "live")
    options = parser.parse_args()
    for case in cases(folder_of(options.folder), options.arms, options.runs):
        report(case)


if __name__ == "__main__":
    main()
