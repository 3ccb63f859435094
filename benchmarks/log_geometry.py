"""Simulate logs with random faults of columns, zeros, units or clocks, and count how often `spelgen logs` names them.

    python benchmarks/log_geometry.py [--arms rpr,ur10e] [--folder ../shared/arms] [--draws 3] [--faults 12] [--first 0]
                                      [--out runs/log_geometry.jsonl]

--draws logs per arm are simulated, with the seeds --first, --first + 1, ... Every log has 20 s of excitation or
pick-and-place, torque noise of 0.5 to 5 %, and friction of one of five kinds. The inertials in the given URDF have
errors of 30 %. Each log is checked without a fault, and then --faults times, each time with one random fault:

- the sign of a joint's position, of its torque, or of both is reversed;
- all columns are permuted, or only the torques, or two torques are exchanged;
- the zero of a joint is offset by a multiple of 90 degrees, or by any angle;
- the direction of gravity in the settings is wrong, or angles are in revolutions or degrees;
- the motion, the torque or all signals of a joint are 40 to 140 ms late or early, or its clock is 0.4 to 1.4 % off.

`spelgen logs` lists hypotheses about the log (`Hypothesis`), the best first; the right hypothesis corrects the fault. A
fault is `named` if the first hypothesis is the right one, `with others` if a later one is, `wrong` if none is. If no
hypothesis is listed, the fault is `invisible` if even with the true inertials the evidence for the right hypothesis is
too small, for example for the zero of a vertical first axis or of a symmetric wrist; otherwise it is not found.

Results are appended to a file of JSON lines; a run continues where it stopped, and the tables include all rows.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from truth import Case, Truth, record_log, wrong_urdf

from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.identification.geometry_search import compare_hypotheses, kinds_of_faults
from spelgen.identification.hypotheses import Hypothesis, HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.motion_samples import DriveLog, MotionSamples
from spelgen.identification.tuning import GEOMETRY
from spelgen.identification.unit_faults import PositionUnit, position_factors
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory

ROBOTS = Path(__file__).parents[1] / "robots"
OWN = ("rpr", "two_link", "scara", "six_dof", "panda", "ur10e")
OTHERS = (
    "kuka_iiwa14_epfl", "abb_irb140", "staubli_tx60", "kinova_gen3_7dof_2f85", "franka_fr3", "ur5e_official", "xarm6",
    "puma560_rtb", "fanuc_m10ia", "aubo_i5",
)  # fmt: skip
KINDS = (
    "position", "torque", "position and torque", "order", "order of torques", "two torques", "zero, 90 degrees",
    "zero, any angle", "gravity", "unit of angles", "late motion", "late torque", "late joint", "clock",
)  # fmt: skip
SECONDS = 20.0
# [rad] largest error of a zero offset that counts as right; [1] of gravity, relative to its magnitude
NEAR = 0.2
NEAR_DELAY = 0.03  # [s] largest error of a delay that counts as right
RESULTS = ("named", "with others", "invisible", "missed", "wrong")


def draw_log(urdf: Path, number: int, folder: Path) -> tuple[Case, Arm, Arm, list[Trajectory]]:
    """Return the random conditions of logs, the arm with wrong inertials, the true arm, and the logs of the true arm.

    urdf: file of the true arm. number: seed of all random values, such as friction, motion and noise. folder: the URDF
    with wrong inertials and a copy of the settings are written to it.
    """
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
    return case, arm, true, record_log(Truth(case, urdf, rng), case, rng)


def samples_of(arm: Arm, logs: Sequence[Trajectory]) -> MotionSamples:
    """Return the filtered samples of logs, as `spelgen logs` uses them."""
    collected = DriveLog(arm.chain.joint_types, arm.actuation.drives(), Preprocessing())
    for log in logs:
        collected.add(log)
    samples = collected.samples()
    assert samples is not None
    return samples


def draw_fault(arm: Chain, kind: str, rng: np.random.Generator) -> Hypothesis:
    """Return a random fault of a kind of `KINDS`, as the hypothesis that corrects it."""
    right, n = Hypothesis.unchanged(arm), len(arm.coordinates)
    joint, present = np.eye(n)[rng.integers(n)], right.source[0]
    order, pair = rng.permutation(n), present.copy()
    first, second = rng.choice(n, 2, replace=False)
    pair[[first, second]] = second, first
    turning = [k for k, x in enumerate(arm.coordinates) if x.joint_type == "revolute"]
    angle = np.pi / 2 * rng.choice([1, 2, -1])
    if kind == "zero, any angle":
        angle = rng.uniform(0.3, np.pi) * rng.choice([1, -1])
    offset = angle * np.eye(n)[rng.choice(turning)]
    delay = rng.uniform(0.04, 0.14) * rng.choice([1, -1]) * joint
    units = [x for x in position_factors(arm, right.scale[0]) if (x < 7).all()]
    direction = rng.normal(size=3)
    if rng.random() < 0.5:
        direction = np.eye(3)[rng.integers(3)] * rng.choice([1, -1])
    x, y, z = map(float, 9.81 * direction / np.linalg.norm(direction))
    sign, ones, none = 1 - 2 * joint, np.ones(n), np.zeros(n)
    return {
        "position": replace(right, scale=np.stack([sign, ones])),
        "torque": replace(right, scale=np.stack([ones, sign])),
        "position and torque": replace(right, scale=np.stack([sign, sign])),
        "order": replace(right, source=np.stack([order, order])),
        "order of torques": replace(right, source=np.stack([present, order])),
        "two torques": replace(right, source=np.stack([present, pair])),
        "zero, 90 degrees": replace(right, offset=offset),
        "zero, any angle": replace(right, offset=offset),
        "gravity": replace(right, gravity=(x, y, z)),
        "unit of angles": replace(right, scale=units[rng.integers(2)]),
        "late motion": replace(right, delay=np.stack([delay, none])),
        "late torque": replace(right, delay=np.stack([none, delay])),
        "late joint": replace(right, delay=np.stack([delay, delay])),
        "clock": replace(right, drift=2 / SECONDS * np.stack([delay, delay])),
    }[kind]


def wrong_log(log: Trajectory, right: Hypothesis) -> Trajectory:
    """Return the log with the fault that the hypothesis `right` corrects, by the inverse of the correction."""
    n = len(right.offset)
    motion, torque = np.argsort(right.source)
    columns = [(log.q - right.offset) / right.scale[0], log.qd / right.scale[0], log.tau / right.scale[1]]
    late = []
    for values, row in zip(columns, (0, 0, 1), strict=True):
        delays = right.delay[row] + np.outer(log.t - log.t[0], right.drift[row])
        late.append(np.column_stack([np.interp(log.t - delays[:, k], log.t, values[:, k]) for k in range(n)]))
    return replace(log, q=late[0][:, motion], qd=late[1][:, motion], tau=late[2][:, torque])


def compared(problem: GeometryProblem) -> list[HypothesisFit]:
    """Return the hypotheses that explain the torques of a log better than the unchanged log does, the best first."""
    units = [PositionUnit(position_factors(problem.arm, problem.unchanged.scale[0]))]
    faults = kinds_of_faults(problem.arm, units)
    return list(compare_hypotheses(problem, faults)[1:])


def is_same(one: Hypothesis, other: Hypothesis) -> bool:
    """Return True if two hypotheses about a log agree within tolerances. A common delay of all signals is ignored.

    The tolerances are `NEAR` for offsets [rad] and for gravity (relative), and `NEAR_DELAY` for delays [s].
    """
    turn = np.angle(np.exp(1j * (one.offset - other.offset)))
    delay, drift = one.delay - other.delay, one.drift - other.drift
    gravity = np.array(one.gravity) - np.array(other.gravity)
    return bool(
        (one.source == other.source).all()
        and np.allclose(one.scale, other.scale)
        and np.abs(turn).max() < NEAR
        and np.abs(delay - delay.mean()).max() < NEAR_DELAY
        and SECONDS * np.abs(drift - drift.mean()).max() < NEAR_DELAY
        and np.linalg.norm(gravity) < NEAR * 9.81
    )


def result_of(arm: Arm, true: Arm, logs: Sequence[Trajectory], kind: str, right: Hypothesis) -> str:
    """Apply a fault to logs, and return the result of `spelgen logs` for them: one of `RESULTS` (see the module).

    arm: given arm, with wrong inertials. true: arm of the logs. logs: logs without the fault. kind: kind of the fault,
    of `KINDS`. right: hypothesis that corrects the fault; the fault is the inverse of this correction.
    """
    drives, chain, ideal = arm.actuation.drives(), arm.chain, true.chain
    if kind == "gravity":  # the fault is in the settings, which state another gravity; the log is right
        chain, ideal = replace(chain, gravity=right.gravity), replace(ideal, gravity=right.gravity)
        right = Hypothesis.unchanged(arm.chain)
    wrong = samples_of(arm, [wrong_log(log, right) for log in logs])
    better = compared(GeometryProblem(chain, wrong, drives.speeds, SECONDS))
    named = [is_same(fit.hypothesis, right) for fit in better]
    if any(named):
        return "named" if named[0] else "with others"
    best = GeometryProblem(ideal, wrong.thinned(GEOMETRY.confirming_samples), drives.speeds, SECONDS)
    unchanged, mended = best.fit(best.unchanged), best.fit(right)
    if named:
        return "wrong"
    visible = unchanged.cost - mended.cost > GEOMETRY.needed
    # Other inertials may explain the torques of an offset zero, which costs only prior probability. The zero is visible
    # only if the right hypothesis also lowers the misfit (contribution of the torque residual to the cost) enough.
    if kind.startswith("zero"):
        visible &= unchanged.misfit - mended.misfit > GEOMETRY.needed / 2
    return "missed" if visible else "invisible"


@dataclass(frozen=True)
class Row:
    """Result for one random log of an arm, with a random fault or without one (kind "clean")."""

    arm: str
    number: int
    motion: str
    noise: float
    kind: str
    result: str


def rows_of(urdf: Path, number: int, faults: int) -> Iterator[Row]:
    """Yield the result for one random log without a fault, then for the same log with each of `faults` random faults.

    number: seed of the log and of the faults. Random faults that change nothing within tolerances are omitted.
    """
    with tempfile.TemporaryDirectory() as folder:
        case, arm, true, logs = draw_log(urdf, number, Path(folder))
    log = (urdf.stem, number, case.motion, case.noise)
    problem = GeometryProblem(arm.chain, samples_of(arm, logs), arm.actuation.drives().speeds, SECONDS)
    clean = compared(problem)
    codes = " ".join(fault.code for fit in clean[:1] for fault in fit.hypothesis.faults)
    yield Row(*log, "clean", f"false: {codes}" if clean else "silent")
    rng = np.random.default_rng([number, 1, *urdf.stem.encode()])
    for fault in range(faults):
        kind = KINDS[(fault + number * faults) % len(KINDS)]
        right = draw_fault(arm.chain, kind, rng)
        if not is_same(right, Hypothesis.unchanged(arm.chain)):
            yield Row(*log, kind, result_of(arm, true, logs, kind, right))


def print_tables(rows: Sequence[Row]) -> None:
    """Print how often faults were named, per kind of fault and per arm, and the findings on clean logs."""
    clean = [row for row in rows if row.kind == "clean"]
    for row in clean:
        if row.result != "silent":
            print(f"clean log with a finding: {row}")
    print(f"clean logs: {len(clean)}, with a finding: {sum(row.result != 'silent' for row in clean)}")
    faults = [row for row in rows if row.kind != "clean"]
    for title, group in (("fault", [x.kind for x in faults]), ("arm", [x.arm for x in faults])):
        print(f"\n| {title} | draws | {' | '.join(RESULTS)} | named, of visible |")
        print(f"|---|{'---|' * (2 + len(RESULTS))}")
        for name in (*dict.fromkeys(group), "all"):
            counts = Counter(x.result for x, of in zip(faults, group, strict=True) if name in (of, "all"))
            visible = counts.total() - counts["invisible"]
            named = counts["named"] + counts["with others"]
            cells = [name, counts.total(), *map(counts.get, RESULTS), f"{named / max(visible, 1):.1%}"]
            print(f"| {' | '.join(str(x or 0) for x in cells)} |")


def main(arguments: Sequence[str] | None = None) -> None:
    """Check random logs with random faults, append the results to a file, and print tables of all its results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--arms", default=",".join(OWN + OTHERS))
    parser.add_argument("--folder", type=Path, default=Path("../shared/arms"))
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--faults", type=int, default=12)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/log_geometry.jsonl"))
    options = parser.parse_args(arguments)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    rows = [Row(**json.loads(line)) for line in lines]
    present = {(row.arm, row.number) for row in rows}
    # logs are the outer loop and arms the inner one, so that an interrupted run covers all arms
    for number in range(options.first, options.first + options.draws):
        for name in options.arms.split(","):
            urdf = (ROBOTS if name in OWN else options.folder) / f"{name}.urdf"
            if (name, number) in present or not urdf.exists():
                continue
            new = list(rows_of(urdf, number, options.faults))
            with options.out.open("a") as file:
                file.writelines(f"{json.dumps(asdict(row))}\n" for row in new)
            rows += new
            print(name, number, dict(Counter(row.result for row in new)), flush=True)
    print_tables(rows)


if __name__ == "__main__":
    main()
