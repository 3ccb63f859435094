"""Estimation of the delay of torques relative to positions in logs, by least squares on time-shifted torques."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import stdtrit

from spelgen.arm.actuation import Drives
from spelgen.dynamics.friction import FrictionModel
from spelgen.errors import Diagnostic
from spelgen.identification.drive_hints import Coupling, DriveProblem, drive_problem, find_coupling
from spelgen.identification.least_squares import block_products, normal_solution, varying
from spelgen.identification.motion_samples import OFFSETS, DriveLog, interpolation
from spelgen.identification.tuning import HINTS, TUNING
from spelgen.logs.dynamics_samples import FREQUENCY
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.runtime.body_chain import BodyChain

FRICTION = FrictionModel(memory=True)


@dataclass(frozen=True)
class TorqueDelay:
    """Delay of logged torques relative to positions.

    Attributes:
        delay: delay [s], positive if torques are logged later than positions; 0 if no delay is significant.
        interval: half the width of the delay's 99 % interval [s].
        coupling: (coupling, ratio) if two motors are coupled, otherwise None. The ratio is the squared torque residual
            with the coupling divided by the squared residual without it (`find_coupling`). If a coupling is found, no
            delay is estimated, since the estimate would be biased.
    """

    delay: float = 0.0
    interval: float = 0.0
    coupling: tuple[Coupling, float] | None = None

    @property
    def notes(self) -> list[Diagnostic]:
        """Message about the delay, or about the motor coupling that prevents its estimation; [] if there is neither."""
        if self.coupling is not None:
            joint, other = (number + 1 for number in self.coupling[0].pair)
            message = (
                f"no torque delay is searched: the motor of joint {joint} seems to turn with joint {other}, too; "
                "`spelgen logs` prints the setting of this coupling"
            )
            return [Diagnostic("info", "no-torque-delay", "logs", None, message)]
        if not self.delay:
            return []
        message = (
            f"torques are logged {1e3 * abs(self.delay):.2f} +- {1e3 * self.interval:.2f} ms "
            f"{'later' if self.delay > 0 else 'earlier'} than positions; identify and torque fits of rigid "
            f"bodies move them, others with 'train --set torque_delay={self.delay:.4g}'"
        )
        return [Diagnostic("info", "torque-delay", "logs", None, message)]


NO_DELAY = TorqueDelay()


@dataclass(frozen=True)
class _Estimate:
    delay: float
    standard_error: float
    squares: float


def find_torque_delay(
    logs: Sequence[Trajectory],
    joint_types: Sequence[str],
    drives: Drives,
    chain: BodyChain,
    preprocessing: Preprocessing,
) -> TorqueDelay:
    """Return the delay of the torques in logs, see `delay_of`.

    Args:
        logs: trajectories with torques.
        joint_types: "revolute" or "prismatic" for each joint.
        drives: input matrix, and matrix from joint speeds to motor speeds.
        chain: chain of the arm's bodies.
        preprocessing: filter, and shortest gap [s] at which recordings are split. Its torque delay is ignored, since
            the delay is estimated here.
    """
    collected = DriveLog(joint_types, drives, preprocessing)
    for log in logs[:: -(-len(logs) // HINTS.trajectories)]:
        collected.add(log)
    samples = collected.samples()
    return NO_DELAY if samples is None else delay_of(drive_problem(chain, drives, samples))


def delay_of(problem: DriveProblem) -> TorqueDelay:
    """Return the delay of the torques in the samples of `problem`, or only a coupling of motors, if one is detected.

    A delay and a coupling are both detected by a decrease of the least-squares torque residual. The delay is estimated
    first. Then the torques are shifted by the delay, and a coupling is searched. If a coupling is found, the delay is
    discarded.
    """
    late, samples = _likely_delay(problem), problem.samples
    if late.delay:
        # The delay is removed before couplings are searched: an uncorrected delay may be mistaken for a coupling.
        delays = np.full((len(problem.size), 4), late.delay)
        problem = problem.of_torques(samples.at(delays)[..., 3])
    coupling = find_coupling(problem)
    return late if coupling is None else TorqueDelay(coupling=coupling)


def _likely_delay(problem: DriveProblem) -> TorqueDelay:
    """Return the delay if it is significant with two friction models; no delay otherwise.

    Dry friction has a state (hysteresis) in one model, and depends only on the velocity in the other. The model with a
    state is ignored if its residual is much larger. The returned delay is of the model with the smaller residual.
    """
    samples = problem.samples
    tau = samples.values[:, :, 3]
    if not varying(problem.rows[..., -1]).any():
        return NO_DELAY
    estimates = []
    # Two friction models are fitted, with and without a friction state. Their dry friction has the same filter as the
    # torques. A delay that only one of the models shows is ascribed to an error of this model.
    _, qd, qdd = samples.motion
    for dry in (samples.bent, samples.direction[..., None]):
        friction = FRICTION.columns(qd, qdd, dry, problem.speeds)
        estimates.append(_estimate(np.concatenate([problem.bodies, friction, tau], axis=2)))
    # The delay must be significant for the model without a friction state: its friction depends only on the current
    # motion, so its errors do not lag behind the motion, and do not resemble a delay. In the model with a friction
    # state, friction depends on past motion: errors of this model lag behind the motion, and resemble a delay.
    memory, direct = estimates
    likely = [direct]
    # On recorded arms, the squared residual with a friction state is 0.3 to 0.8 times the squared residual without. A
    # factor above 2 shows that the state does not describe the friction, and the model with the state is ignored.
    if memory.squares <= 2.0 * direct.squares:
        likely.append(memory)
    best = min(likely, key=lambda x: x.squares)
    # the delay must be significant at 1 %, so that a delay is rarely found in logs without one
    quantile = -stdtrit(HINTS.blocks - 1, 0.01 / 2)
    deviations = np.array([x.delay / x.standard_error for x in likely])
    if not ((deviations > quantile).all() or (deviations < -quantile).all()):
        return NO_DELAY
    return TorqueDelay(round(best.delay, 6), float(quantile * best.standard_error))


def _estimate(rows: np.ndarray) -> _Estimate:
    """Return the delay with the smallest torque residual, with its standard error.

    The standard error is from a jackknife over blocks of time, since model errors are correlated over seconds. rows:
    (S, n, K + D) regressor, and torques at each of the D times `OFFSETS` after the samples.
    """
    products = block_products(rows, HINTS.blocks)
    deviation = rows[..., -len(OFFSETS) :].std(axis=(0, 2))
    least = np.maximum(deviation, 1e-3 * deviation.max())
    noise = least
    for _ in range(TUNING.rounds):
        by_block = np.tensordot(1 / noise**2, products, 1)
        total = by_block.sum(axis=0)
        delay, unexplained = _least(total)
        squares = unexplained @ products.sum(axis=1) @ unexplained
        noise = np.sqrt(np.maximum(squares / len(rows), np.square(TUNING.least_noise * least)))
    spread = np.var([_least(total - block)[0] for block in by_block]) * (HINTS.blocks - 1)
    # The standard error is infinite in two cases. Above `longest_delay`, the apparent delay may be due to friction. If
    # the jackknife estimates of all blocks are equal, there are too few samples.
    unknown = abs(delay) > HINTS.longest_delay or spread == 0
    standard_error = np.inf if unknown else float(np.sqrt(spread))
    return _Estimate(delay, standard_error, float((squares / least**2).sum()))


def _least(products: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the delay [s] with the smallest torque residual, and the coefficients (K + D,) of this residual.

    The residual is Y p - T w, with the regressor Y (K columns), the parameters p, and D columns T of torques at the
    times `OFFSETS` relative to the samples. T w is the torque at the delay: w (D,) are the weights of interpolation by
    a cubic spline, which is accurate because filtered torques are smooth. The coefficients are p and -w.

    products: (K + D, K + D) Gram matrix of the columns of Y and T.
    """
    moved = len(OFFSETS)
    parameters = normal_solution(products, moved)
    left = products[-moved:, -moved:] - products[-moved:, :-moved] @ parameters

    def squares(delay: float) -> float:
        shape = interpolation()(delay)
        return float(shape @ left @ shape)

    times = OFFSETS / FREQUENCY
    near = times[np.abs(times) <= 2 * HINTS.longest_delay]
    nearest = min(near, key=squares)
    step = near[1] - near[0]
    best = minimize_scalar(
        squares, bounds=(nearest - step, nearest + step), method="bounded", options={"xatol": 1e-6}
    )
    shape = interpolation()(best.x)
    return float(best.x), np.append(parameters @ shape, -shape)
