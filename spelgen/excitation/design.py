"""Design of exciting motions: L-BFGS improves the best of several random motions.

If the result has a contact, the design is repeated with another seed and a smaller position range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.optimize import minimize

from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm
from spelgen.errors import ArmError, SettingsError
from spelgen.excitation.bounds import MotionBounds, Surroundings, motion_bounds, read_surroundings
from spelgen.excitation.criterion import Criterion
from spelgen.excitation.excitation import Excitation
from spelgen.excitation.trajectory import ExcitationTrajectory, approach
from spelgen.excitation.tuning import TUNING
from spelgen.labels import counted

if TYPE_CHECKING:
    from spelgen.excitation.collisions import Collisions


def excite(
    arm: Arm,
    *,
    duration: float = 30.0,
    sample_rate: float = 100.0,
    harmonics: int | None = None,
    reach: float = 0.9,
    speed: float = 0.7,
    acceleration: float | Sequence[float] | None = None,
    start: Sequence[float] | None = None,
    surroundings: Surroundings | Path | str | None = None,
    trials: int = 100,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Excitation:
    """Return an exciting motion, which starts and ends at rest; the same arguments give the same motion.

    The optimizer minimizes the condition number of the base regressor, with penalties (see `criterion`). An approach
    from ``start`` precedes the motion. The motion keeps the limits of position and velocity, also of <mimic> joints. It
    keeps effort limits, too, if the URDF has effort limits and inertials and the optimizer finds such a motion. If the
    URDF has collision geometry and Pinocchio is installed, motion and approach keep a clearance between links, and to
    the surroundings.

    Args:
        arm: configured arm.
        duration: duration of the motion, which is one period [s]. sample_rate: approximate sample rate [Hz].
        harmonics: number of harmonics; default: 0.4 per second, at least 5.
        reach, speed: fractions of the position ranges and of the velocity limits that are used.
        acceleration: largest acceleration of all joints or per joint [rad/s^2, m/s^2]; default: unlimited in the
            motion; in the approach, the acceleration that reaches the used speed in one second.
        start: position from which the approach starts, (n,) [rad, m]; default: zero if the limits allow it, per joint,
            otherwise the middle of the range.
        surroundings: floor, boxes and clearance, or the path of a YAML file; default: a clearance of 10 mm.
        trials: evaluations of the criterion by the optimizer, in addition to 40 random motions.
        seed: seed of the random motions.
        progress: function of the numbers of finished and of all trials.

    Raises SettingsError for an invalid value, ArmError for a joint without a range and if all motions had a contact.
    """
    harmonics = _checked_harmonics(duration, sample_rate, harmonics, reach, speed)
    ranges = arm.robot.joint, arm.settings.simulation.positions
    limits = motion_bounds(arm.chain, 1.0, 1.0, *ranges)
    bounds = motion_bounds(arm.chain, reach, speed, *ranges)
    bounds, strongest = _accelerated(bounds, acceleration, arm.chain)
    collisions, statement = _collisions(arm, surroundings, limits)
    beginning = _start(start, arm.chain, limits, collisions)
    contacts = []
    for attempt in range(TUNING.attempts):
        fraction = TUNING.range_factor**attempt
        trajectory = ExcitationTrajectory(duration, harmonics, bounds.narrowed(fraction))
        criterion = Criterion(arm.chain, trajectory, collisions)
        # Each attempt has another seed in addition to a smaller range, because the same random motions would probably
        # lead to the same contact.
        starts = np.random.default_rng(seed + attempt).standard_normal((TUNING.starts, trajectory.size))
        best = _improved(criterion, min(starts, key=criterion.value), trials, progress)
        motion = trajectory.motion(best, np.linspace(0.0, duration, round(duration * sample_rate) + 1))
        to_motion = approach(beginning, motion.q[0], bounds.speed, strongest, sample_rate)
        contact = None if collisions is None else collisions.contact(to_motion.then(motion))
        if contact is None:
            break
        contacts.append(str(contact))
    else:
        do = "use less of the ranges (--reach), begin elsewhere (--from), or lower the clearance"
        raise ArmError(f"no motion without a contact: {'; '.join(contacts)}", element="excite", do=do)
    if attempt:
        earlier = f"{counted(attempt, 'design')} from seed {seed} on had contacts"
        statement += f" {earlier}; this one has seed {seed + attempt}, {reach * fraction:.0%} of the ranges."
    random, states = criterion.states(starts[0]), np.stack([motion.q, motion.qd, motion.qdd])
    return Excitation(
        arm=arm.chain,
        motion=motion,
        approach=to_motion,
        collisions=statement,
        parameters=len(criterion.columns),
        first=criterion.condition(random),
        first_overruns=bool((criterion.largest_efforts(random) > 1).any()),
        condition=criterion.condition(criterion.states(best)),
        efforts=criterion.largest_efforts(torch.from_numpy(states)),
    )


def _checked_harmonics(
    duration: float, sample_rate: float, harmonics: int | None, reach: float, speed: float
) -> int:
    """Return ``harmonics``; for None, 0.4 per second of ``duration``, at least 5.

    Raises SettingsError if an argument has an invalid value. The arguments are explained in `excite`.
    """
    bounded = {"duration": (duration, inf), "sample_rate": (sample_rate, inf)}
    bounded |= {"reach": (reach, 1.0), "speed": (speed, 1.0)}
    for name, (value, largest) in bounded.items():
        if not 0 < value <= largest or value == inf:
            expected = "a positive number" if largest == inf else "more than 0, at most 1"
            raise SettingsError(repr(value), element=f"excite: {name}", expected=expected)
    if harmonics is None:
        return max(TUNING.min_harmonics, round(TUNING.harmonics_per_second * duration))
    if harmonics < 2:
        raise SettingsError(repr(harmonics), element="excite: harmonics", expected="2 or more")
    return harmonics


def _accelerated(
    bounds: MotionBounds, acceleration: float | Sequence[float] | None, arm: Chain
) -> tuple[MotionBounds, np.ndarray]:
    """Return ``bounds`` with a limit of the acceleration, and the limits for the approach, (n,) [rad/s^2, m/s^2].

    ``acceleration`` limits the exciting motion and the approach, which is the motion to its first position. None: the
    bounds are unchanged, and the approach reaches its largest speed in one second. arm: for the number and the names of
    the joints.
    """
    if acceleration is None:
        return bounds, bounds.speed
    strongest = _joint_values("acceleration", acceleration, arm, positive=True)
    return replace(bounds, acceleration=strongest), strongest


def _joint_values(name: str, values: float | Sequence[float], arm: Chain, *, positive: bool) -> np.ndarray:
    """Return an argument of `excite` as one number per joint, (n,). Raises SettingsError if it is invalid.

    name: name of the argument, for the error. positive: True if the numbers must be positive; a single number then
    applies to all joints.
    """
    count = len(arm.coordinates)
    array = np.atleast_1d(np.array(values, dtype=float))
    if positive and array.shape == (1,):
        array = np.repeat(array, count)
    is_valid = array.shape == (count,) and np.isfinite(array).all()
    if not is_valid or (positive and array.min() <= 0):
        expected = f"one {'positive ' if positive else ''}number per joint: {', '.join(arm.joint_names)}"
        raise SettingsError(repr(values), element=f"excite: {name}", expected=expected)
    return array


def _collisions(
    arm: Arm, surroundings: Surroundings | Path | str | None, limits: MotionBounds
) -> tuple[Collisions | None, str]:
    """Return the `Collisions` of an arm, and a text for users that states the checked collisions.

    If collisions cannot be checked, the first result is None and the text states the reason.
    """
    if not isinstance(surroundings, Surroundings):
        surroundings = Surroundings() if surroundings is None else read_surroundings(Path(surroundings))
    try:
        # Pinocchio is an optional dependency, so the import is in this function.
        from spelgen.excitation.collisions import Collisions

        collisions = Collisions(arm, surroundings, limits)
    except ModuleNotFoundError as error:
        reason = f"pip install 'spelgen[simulate]' for the package {error.name}"
    except LookupError as error:
        reason = str(error.args[0])
    else:
        return collisions, collisions.statement
    return None, f"Not checked: collisions ({reason})."


def _start(
    start: Sequence[float] | None, arm: Chain, limits: MotionBounds, collisions: Collisions | None
) -> np.ndarray:
    """Return the position at which the approach to the exciting motion starts, (n,) [rad, m].

    start: the user's choice. None: zero for each joint whose limits allow it, the middle of the limits for the others;
    the middle for all joints if that position has a contact. collisions: None if contacts are not checked.

    Raises SettingsError for an invalid position, and ArmError for a position with a contact.
    """
    if start is None:
        middle = (limits.low + limits.high) / 2
        # By default, the approach starts at zero if the limits allow it: most arms are at zero when their controller
        # starts.
        position = np.where((limits.low <= 0) & (limits.high >= 0), 0.0, middle)
        if collisions is not None and collisions.contact_at(position):
            position = middle
    else:
        position = _joint_values("start", start, arm, positive=False)
    for joint, value, low, high in zip(arm.joint_names, position, limits.low, limits.high, strict=True):
        if not low <= value <= high:
            element = f"excite: start of {joint!r}"
            raise SettingsError(f"{value:g}", element=element, expected=f"{low:.6g} .. {high:.6g}")
    contact = None if collisions is None else collisions.contact_at(position)
    if contact is not None:
        element, do = "excite: start", "name a free position by --from, or lower the clearance"
        raise ArmError(f"a contact at the start: {contact}", element=element, do=do)
    return position


def _improved(
    criterion: Criterion, initial: np.ndarray, trials: int, progress: Callable[[int, int], None]
) -> np.ndarray:
    """Minimize the criterion by L-BFGS from initial parameters (size,); return the parameters of the smallest value.

    The criterion is not differentiable if singular values are equal, or if two samples have the largest speed. L-BFGS
    is efficient for such functions (Lewis and Overton, Math. Program. 141:135, 2013). The last parameters may not be
    the best, so the values of all `trials` evaluations are compared.

    The search amplifies rounding errors, which depend on the processor, to other motions. The parameters, the criterion
    and its gradient are therefore rounded, and the motion is the same on all processors.
    """
    initial = initial.round(TUNING.decimals)
    best, lowest, done = initial, criterion.value(initial), 0
    if not isfinite(lowest):
        return initial

    def evaluate(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the criterion and its gradient (size,) at parameters (size,), for the optimizer.

        The parameters are stored in `best` if the criterion is smaller than at all earlier parameters.
        """
        nonlocal best, lowest, done
        parameters = parameters.round(TUNING.decimals)
        value, gradient = criterion.value_and_gradient(parameters)
        value, gradient = round(value, TUNING.decimals), gradient.round(TUNING.decimals)
        done += 1
        if value < lowest:
            best, lowest = parameters, value
        progress(min(done, trials), trials)
        return value, gradient

    # The tolerance of the criterion, `ftol`, is zero, because a step with a small decrease may be followed by a step
    # with a large decrease. The search ends after `trials` evaluations.
    options = {"maxfun": trials, "maxiter": trials, "maxcor": TUNING.history, "ftol": 0.0}
    minimize(evaluate, initial, jac=True, method="L-BFGS-B", options=options)
    return best
