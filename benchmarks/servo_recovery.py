"""Servo parameters relative to kp, fitted to logs of simulated arms and compared with the true parameters.

    python benchmarks/servo_recovery.py ARM.urdf [--seeds 40] [--seconds 16] [--mujoco [--backlash 0.0025]]

The ratios are kd, armature, dry friction, dead zone and static error (dry friction + dead zone), each relative to kp.
For each seed three recordings at 50 Hz, with different commands, are fitted as in `spelgen train`, and the true ratios
are compared with the 95 % intervals. The arm is the same for all seeds. It has servos with a delay and with the URDF's
effort limits, armatures, dry friction, encoders of twelve bits, and with --dead-zone a dead zone of the servos. This
file integrates M and bias of the URDF by semi-implicit Euler in steps of a millisecond, with dry friction as impulses.
With --mujoco MuJoCo simulates the arm, and gears may have backlash between the armature and the link.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

import spelgen
from spelgen.logs.trajectory import Trajectory

RATE, STEP, RECORDINGS = 50, 1e-3, 3  # sample rate of logs [Hz]; integration step [s]; recordings per seed
# True servos: kp of joint 1 [Nm/rad]; kd [s], armature [s^2] and dry friction [rad] relative to kp; delay [s].
KP, LAG, ARMATURE, DRY, DELAY = 20.0, 0.06, 1.4e-3, 8e-3, 0.02
SMALLEST = 0.4  # [1] kp of the last joint relative to joint 1; linear between them
ENCODER = 2 * np.pi / 4096


def commands(random: np.random.Generator, t: np.ndarray, n: int) -> np.ndarray:
    """Return random commands at times t (T,) [s], (T, n) [rad]: sines about levels that jump every two seconds."""
    frequency, phase = (
        np.exp(random.uniform(np.log(0.05), np.log(1.2), (3, n))),
        random.uniform(0, 6.3, (3, n)),
    )
    sines = 0.15 * np.sin(2 * np.pi * frequency * t[:, None, None] + phase).sum(axis=1)
    levels = random.uniform(-0.4, 0.4, (int(t[-1] / 2) + 1, n))
    return np.asarray(sines + levels[(t / 2).astype(int)])


def simulated(model: Any, u: torch.Tensor, dead_zone: float, limit: torch.Tensor) -> torch.Tensor:
    """Simulate an arm with servos from rest at the first command; return its positions, (B, T, n) [rad].

    The gains kp and kd, armature, dry friction and delay of the servos are the constants of this file.

    Args:
        model: model of the arm; only its bias torques and its M are used, M with the armatures of the true servos in
            place of its own.
        u: (B, T, n) commands [rad] of B motions.
        dead_zone: position error below which servos give no torque [rad].
        limit: (n,) largest torque [Nm].
    """
    size = torch.linspace(1.0, SMALLEST, u.shape[-1]).double() * KP
    rotors = torch.diag(size * ARMATURE - model.armature)
    damping, most = torch.diag(STEP / 2 * size * LAG), STEP * size * DRY
    per, late = round(1 / RATE / STEP), round(DELAY / STEP)
    q, qd, found = u[:, 0].clone(), torch.zeros_like(u[:, 0]), []
    for k in range(per * u.shape[1]):
        if k % per == 0:
            found.append(q)
        wrong = u[:, max(0, k - late) // per] - q
        pull = size * (wrong - wrong.clamp(-dead_zone, dead_zone)) - size * LAG * qd
        pull = pull.clamp(-limit, limit)
        inverse = torch.linalg.inv(model.mass_matrix(q) + rotors + damping)
        qd = qd + STEP * (inverse @ (pull - model.nonlinear_effects(q, qd)).unsqueeze(-1)).squeeze(-1)
        impulse = torch.zeros_like(qd)
        for joint in 4 * [*range(len(size))]:  # dry friction: projected Gauss-Seidel on impulses, 4 sweeps
            wanted = impulse[:, joint] - qd[:, joint] / inverse[:, joint, joint]
            change = wanted.clamp(-most[joint], most[joint]) - impulse[:, joint]
            impulse[:, joint] += change
            qd = qd + inverse[:, :, joint] * change.unsqueeze(-1)
        q = q + STEP * qd
    return torch.stack(found, dim=1)


def recordings(arm: spelgen.Arm, asked: argparse.Namespace) -> Iterator[list[Trajectory]]:
    """Yield, for each seed, `RECORDINGS` logs of the simulated arm: commands, and positions rounded to encoder steps.

    The velocities are differences of these positions. asked: options of the command line.
    """
    model = spelgen.build(arm, "closed-form")
    t = np.arange(0, asked.seconds, 1 / RATE)
    limit = torch.tensor([x.effort or float("inf") for x in arm.chain.coordinates]).double()
    every = [
        [commands(np.random.default_rng((seed, k)), t, model.n) for k in range(RECORDINGS)]
        for seed in range(asked.seeds)
    ]
    if asked.mujoco:
        found = (in_mujoco(asked.urdf, arm, u, limit.numpy(), asked.backlash) for u in every)
    else:
        with torch.no_grad():
            flat = torch.from_numpy(np.concatenate(every))
            found = iter(
                simulated(model, flat, asked.dead_zone, limit).unflatten(0, (-1, RECORDINGS)).numpy()
            )
    for u, q in zip(every, found, strict=True):
        q, nothing = np.round(q / ENCODER) * ENCODER, np.zeros((len(t), 0))
        yield [
            Trajectory(t, x, np.gradient(x, t, axis=0), nothing, f"motion {k}", u=each)
            for k, (x, each) in enumerate(zip(q, u, strict=True))
        ]


def in_mujoco(
    urdf: Path, arm: spelgen.Arm, u: list[np.ndarray], limit: np.ndarray, backlash: float
) -> np.ndarray:
    """Simulate the servos of `simulated` in MuJoCo, with backlash of the gears; return positions, (B, T, n) [rad].

    Args:
        urdf: file of the arm.
        arm: the arm of the file.
        u: commands (T, n) [rad] of B motions.
        limit: (n,) largest torque [Nm].
        backlash: half of the play of the gears [rad].
    """
    # imported here, as MuJoCo is an optional dependency that --mujoco needs
    from servo_mujoco import arm_with_servos, positions

    joints = [x.name for x in arm.chain.coordinates]
    kp = np.linspace(1.0, SMALLEST, len(joints)) * KP
    ratios = {"kd": LAG, "armature": ARMATURE, "dry": DRY}
    model = arm_with_servos(urdf, joints, kp, ratios, limit, backlash)
    return np.stack([positions(model, joints, each, 1 / RATE, DELAY) for each in u])


def main() -> None:
    """Simulate and fit recordings per seed; print errors of kd / kp and other ratios, and coverage of the intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("urdf", type=Path)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=16.0)
    parser.add_argument("--dead-zone", type=float, default=0.0, help="half its width [rad]")
    parser.add_argument("--mujoco", action="store_true", help="MuJoCo simulates")
    parser.add_argument("--backlash", type=float, default=0.0, help="of gears in MuJoCo, half of it [rad]")
    parser.add_argument("--preset", default="hybrid")
    asked = parser.parse_args()
    arm = spelgen.load_arm(asked.urdf)
    if arm.settings.input != "position":
        parser.error(f"{asked.urdf.with_suffix('.yaml')} has to say 'input: position'")
    if (asked.backlash and not asked.mujoco) or (asked.dead_zone and asked.mujoco):
        parser.error("--backlash belongs to --mujoco, --dead-zone to the arm without")
    truths = {"kd": LAG, "armature": ARMATURE, "dry": DRY, "static_error": DRY + asked.dead_zone}
    truths |= {"dead_zone": asked.dead_zone} if asked.dead_zone else {}
    errors, held, left = {x: [] for x in truths}, {x: [] for x in truths}, {x: 0 for x in truths}
    for seed, logs in enumerate(recordings(arm, asked)):
        since = time.monotonic()
        found = spelgen.fit(spelgen.build(arm, asked.preset), logs).record.servo
        for what, truth in truths.items():
            told = [x[what] for x in found["joints"] if what in x and x[what]["determined"]]
            left[what] += len(found["joints"]) - len(told)
            errors[what] += [x["value"] / truth - 1 for x in told]
            held[what] += [x["low"] <= truth <= x["high"] for x in told]
        row = ", ".join(
            f"{what} {100 * np.median(np.abs(x)):.2f} % ({sum(held[what])} of {len(x)} held)"
            for what, x in errors.items()
            if x
        )
        print(f"seed {seed}: {time.monotonic() - since:.0f} s; median errors so far {row}", flush=True)
    print("             bias   median   90 % below   within 3 %   intervals that hold the truth   left open")
    for what, x in ((what, np.array(x)) for what, x in errors.items() if x):
        print(
            f"{what:12}{100 * x.mean():5.2f} %{100 * np.median(np.abs(x)):7.2f} %"
            f"{100 * np.quantile(np.abs(x), 0.9):11.2f} %{100 * np.mean(np.abs(x) <= 0.03):11.1f} %"
            f"{100 * np.mean(held[what]):21.1f} % of {len(x):4}{left[what]:10}"
        )


if __name__ == "__main__":
    main()
