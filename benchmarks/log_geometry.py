"""Draw faults of the geometry of logs, and count how often `spelgen logs` names the right line.

    python benchmarks/log_geometry.py [--arms rpr,ur10e] [--folder ../shared/arms] [--draws 3] [--faults 12] [--first 0]

Every draw is an arm with inertials 30 % wrong in the URDF, friction of one of five kinds, noise of 0.5 to 5 % of the
torques, and 20 s of excitation or pick-and-place. The log is compared unchanged, and with single random faults:
the sense of a joint's position, torque or both, an order of all columns or of the torques, a zero offset (a multiple of
90 degrees, or any), another gravity than the settings state, and angles in revolutions or small angles in degrees.

A fault is named if the first reading is the right one, named with others if it is among the readings that the
message lists, and not found without a finding. It is invisible if the evidence for the right reading is below the
threshold even with the inertials of the true arm: a vertical first axis, a wrist that is symmetric.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from truth import Case, Truth, record_log, wrong_urdf

from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.identification.drive_hints import DriveLog
from spelgen.identification.geometry_search import angle_scalings, compare_readings
from spelgen.identification.log_geometry import GeometryProblem, Hypothesis, MotionSamples
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.preprocessing import Preprocessing

ROBOTS = Path(__file__).parents[1] / "robots"
OWN = ("rpr", "two_link", "scara", "six_dof", "panda", "ur10e")
OTHERS = (
    "kuka_iiwa14_epfl", "abb_irb140", "staubli_tx60", "kinova_gen3_7dof_2f85", "franka_fr3", "ur5e_official", "xarm6",
    "puma560_rtb", "fanuc_m10ia", "aubo_i5",
)  # fmt: skip
KINDS = (
    "position", "torque", "position and torque", "order", "order of torques", "two torques", "zero, 90 degrees",
    "zero, any angle", "gravity", "unit of angles",
)  # fmt: skip
SECONDS = 20.0
NEAR = 0.2  # rad, and of the size of gravity: angles that are found within it are right
RESULTS = ("named", "with others", "invisible", "missed", "wrong")


def draw_log(urdf: Path, number: int, folder: Path) -> tuple[Case, Arm, Arm, MotionSamples]:
    """Return a case, the arm of its wrong URDF, the true arm, and samples of its log."""
    rng = np.random.default_rng([number, *urdf.stem.encode()])
    case = Case(
        number=number,
        arm=urdf.stem,
        urdf_error=0.3,
        friction=str(rng.choice(["coulomb", "stribeck", "bristles", "load", "asymmetric"])),
        armature=bool(rng.random() < 0.7),
        offsets=bool(rng.random() < 0.3),
        springs=False,
        motion=str(rng.choice(["excitation", "pick-and-place"])),
        seconds=SECONDS,
        sample_rate=float(rng.choice([100.0, 200.0, 500.0])),
        noise=float(rng.choice([0.005, 0.01, 0.02, 0.05])),
        delay=0.0,
    )
    given = folder / urdf.name
    given.write_bytes(wrong_urdf(urdf, case.urdf_error, rng))
    settings = urdf.with_suffix(".yaml")
    if settings.exists():
        given.with_suffix(".yaml").write_bytes(settings.read_bytes())
    arm, true = load_arm(given), load_arm(urdf)
    collected = DriveLog(arm.chain.joint_types, arm.actuation.drives(), Preprocessing())
    for log in record_log(Truth(case, urdf, rng), case, rng):
        collected.add(log)
    samples = collected.samples()
    assert samples is not None
    return case, arm, true, MotionSamples(samples.q, samples.qd, samples.qdd, samples.tau)


def draw_fault(arm: Chain, kind: str, rng: np.random.Generator) -> Hypothesis:
    """Return the reading that mends a fault of a kind."""
    right, n = Hypothesis.unchanged(arm), len(arm.coordinates)
    sign, offset, order = np.ones(n), np.zeros(n), rng.permutation(n)
    sign[rng.integers(n)] = -1.0
    turning = [k for k, x in enumerate(arm.coordinates) if x.joint_type == "revolute"]
    angle = np.pi / 2 * rng.choice([1, 2, -1])
    if kind == "zero, any angle":
        angle = rng.uniform(0.3, np.pi) * rng.choice([1, -1])
    offset[rng.choice(turning)] = angle
    pair = np.arange(n)
    first, second = rng.choice(n, 2, replace=False)
    pair[[first, second]] = second, first
    direction = rng.normal(size=3)
    if rng.random() < 0.5:
        direction = np.eye(3)[rng.integers(3)] * rng.choice([1, -1])
    x, y, z = map(float, 9.81 * direction / np.linalg.norm(direction))
    return {
        "position": replace(right, motion_scale=sign),
        "torque": replace(right, torque_scale=sign),
        "position and torque": replace(right, motion_scale=sign, torque_scale=sign),
        "order": replace(right, motion_source=order, torque_source=order),
        "order of torques": replace(right, torque_source=order),
        "two torques": replace(right, torque_source=pair),
        "zero, 90 degrees": replace(right, offset=offset),
        "zero, any angle": replace(right, offset=offset),
        "gravity": replace(right, gravity=(x, y, z)),
        "unit of angles": replace(right, motion_scale=angle_scalings(arm)[rng.integers(2)].motion),
    }[kind]


def is_same(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether two readings are the same but for small angles."""
    turn = np.angle(np.exp(1j * (one.offset - other.offset)))
    gravity = np.array(one.gravity) - np.array(other.gravity)
    return bool(
        (one.motion_source == other.motion_source).all()
        and (one.torque_source == other.torque_source).all()
        and np.allclose(one.motion_scale, other.motion_scale)
        and np.allclose(one.torque_scale, other.torque_scale)
        and np.abs(turn).max() < NEAR
        and np.linalg.norm(gravity) < NEAR * 9.81
    )


def result_of(arm: Arm, true: Arm, samples: MotionSamples, kind: str, right: Hypothesis) -> str:
    """Return the result for a fault, one of `RESULTS`."""
    drives, chain, ideal = arm.actuation.drives(), arm.chain, true.chain
    if kind == "gravity":  # the log is right, and the settings state another gravity
        chain, ideal = replace(chain, gravity=right.gravity), replace(ideal, gravity=right.gravity)
        right = Hypothesis.unchanged(arm.chain)
    wrong = right.logged(samples)
    comparison = compare_readings(
        GeometryProblem(chain, wrong, drives.speeds, SECONDS), angle_scalings(chain)
    )
    named = [is_same(fit.hypothesis, right) for fit in comparison.better]
    if any(named):
        return "named" if named[0] else "with others"
    best = GeometryProblem(ideal, wrong.thinned(GEOMETRY.confirming_samples), drives.speeds, SECONDS)
    unchanged, mended = best.fit(best.unchanged), best.fit(right)
    if named:
        return "wrong"
    visible = unchanged.cost - mended.cost > GEOMETRY.needed
    if kind.startswith("zero"):  # the masses must not be able to make up for it
        visible &= unchanged.misfit - mended.misfit > GEOMETRY.needed / 2
    return "missed" if visible else "invisible"


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, compare, and print the tables by kind and by arm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--arms", default=",".join(OWN + OTHERS))
    parser.add_argument("--folder", type=Path, default=Path("../shared/arms"))
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--faults", type=int, default=12)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args(arguments)
    by_kind: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    clean: Counter[str] = Counter()
    for name in options.arms.split(","):
        urdf = (ROBOTS if name in OWN else options.folder) / f"{name}.urdf"
        if not urdf.exists():
            print(f"left out: no {urdf}")
            continue
        by_arm: Counter[str] = Counter()
        for number in range(options.first, options.first + options.draws):
            with tempfile.TemporaryDirectory() as folder:
                case, arm, true, samples = draw_log(urdf, number, Path(folder))
            unchanged = compare_readings(
                GeometryProblem(arm.chain, samples, arm.actuation.drives().speeds, SECONDS),
                angle_scalings(arm.chain),
            )
            clean["false" if unchanged.better else "silent"] += 1
            rng = np.random.default_rng([number, 1])
            for fault in range(options.faults):
                kind = KINDS[(fault + number) % len(KINDS)]
                right = draw_fault(arm.chain, kind, rng)
                if is_same(right, Hypothesis.unchanged(arm.chain)):
                    continue
                result = result_of(arm, true, samples, kind, right)
                by_kind[kind][result] += 1
                by_arm[result] += 1
                if result in ("missed", "wrong"):
                    print(f"  {name} {number} {case.motion} noise {case.noise}: {kind} {result}", flush=True)
        print(f"{name}: {dict(by_arm)}", flush=True)
    print(f"clean logs: {dict(clean)}")
    print(f"| fault | draws | {' | '.join(RESULTS)} |")
    print(f"|---|{'---|' * (1 + len(RESULTS))}")
    for kind, counts in by_kind.items():
        print(f"| {kind} | {counts.total()} | {' | '.join(str(counts[x]) for x in RESULTS)} |")


if __name__ == "__main__":
    main()
