"""Detection of signals that are cut off: clipped torques, torques without sign, positions at a mechanical stop.

At a limit a signal is constant at its largest or smallest value: it has a flat top. But a flat top is no proof of a
limit, since torques are also constant at rest and during uniform acceleration. It is a limit if, in addition, the
torque contradicts the least-squares model of all samples outside flat tops. Torques were logged without
sign if the model explains them much better with restored signs.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from spelgen.errors import Diagnostic, LogError
from spelgen.identification.least_squares import varying
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY
from spelgen.labels import UNITS
from spelgen.logs.checks import Findings
from spelgen.logs.unit_checks import is_one_sided

CLIPPED, UNSIGNED, AT_A_STOP = "torque-clipped", "torque-without-sign", "at-a-stop"
SIDES = np.array([-1.0, 1.0])


class FlatTops(NamedTuple):
    """Flat bottoms and tops of the positions and torques of n joints: extreme values at which a signal is constant.

    Attributes:
        q: (2, n) lowest and highest positions [rad, m]; NaN for an extreme that is not flat.
        tau: (2, n) lowest and highest torques [Nm, N]; NaN for an extreme that is not flat.
        shares: (2, n) fraction of the samples whose torque is at the flat bottom or top.
    """

    q: np.ndarray
    tau: np.ndarray
    shares: np.ndarray

    @classmethod
    def of(cls, q: np.ndarray, tau: np.ndarray) -> FlatTops:
        """Return the flat bottoms and tops of positions q and torques tau of one trajectory, (T, n) each.

        A flat top is a highest value at which a signal stays, as if it were clipped (see `flat_tops`).
        """
        return cls(flat_tops(q)[0], *flat_tops(tau))

    @classmethod
    def joined(cls, trajectories: Sequence[FlatTops]) -> FlatTops:
        """Return the lowest flat bottom and the highest flat top of each signal in several trajectories; NaN if none.

        The fractions of samples at flat bottoms and tops (`shares`) are means over the trajectories.
        """
        q, tau, shares = map(np.stack, zip(*trajectories, strict=True))
        sides = SIDES[:, None]
        return cls(
            sides * np.fmax.reduce(sides * q), sides * np.fmax.reduce(sides * tau), shares.mean(axis=0)
        )


def flat_tops(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the flat bottoms and tops of n signals (T, n).

    Two arrays (2, n) are returned: the lowest and highest values, NaN for an extreme that is not flat, and the
    fractions of the samples at them. At a flat top, a narrow band at the extreme value contains many more samples than
    the adjacent band, which is three times as wide; at the peak of a sinusoid both contain equally many.
    """
    upright = SIDES[:, None, None] * values
    tops = upright.max(axis=1)
    # the band is half a per cent of the signal's range, which is wide enough for the noise of clipped torques
    width = 0.005 * np.ptp(values, axis=0)
    shares = (upright >= (tops - width)[:, None]).mean(axis=1)
    below = (upright >= (tops - 4 * width)[:, None]).mean(axis=1) - shares
    is_flat = (shares > 0.01) & (shares > 2.0 * below) & (width > 0)
    return np.where(is_flat, SIDES[:, None] * tops, np.nan), np.where(is_flat, shares, 0.0)


def find_unsigned(problem: GeometryProblem) -> list[LogError]:
    """Return an error that names the joints whose torques were logged as magnitudes; [] if there are none.

    The signs are estimated in a few alternations: the torques get the signs of the model's torques, then the model is
    fitted again. A joint is named if both signs occur and lower its squared residual much. If only one sign occurs, the
    load of the joint may indeed always have the same direction.
    """
    problem = problem.thinned(GEOMETRY.confirming_samples)
    signals = problem.unchanged.signals(problem.samples)
    tau, qd = signals.tau, signals.motion[1]
    suspects = varying(tau) & is_one_sided(tau)
    if not suspects.any():
        return []
    fits = []
    # The signs of the suspected torques are unknown at each sample. Two initial guesses are refined: the signs of the
    # torques predicted with the URDF's parameters, and the signs of the velocities. The second guess is good for joints
    # with little load, whose torque is mostly friction.
    for torque in (problem.reference_torques(problem.unchanged), qd):
        for _ in range(4):
            signs = np.where(suspects, np.sign(torque * tau), 1.0)
            fit = problem.with_signs(signs).fit(problem.unchanged)
            torque = problem.residual(problem.unchanged, fit.parameters) + tau
        fits.append((fit.cost, fit.errors, signs))
    _, errors, signs = min(fits, key=itemgetter(0))
    if errors.max() > GEOMETRY.no_advice:
        # Signs do not explain the torques of all joints: the log has another fault, such as exchanged columns.
        return []
    squares = errors * (signs * tau).var(axis=0)
    ratio = squares / np.maximum(problem.fit(problem.unchanged).errors * tau.var(axis=0), 1e-30)
    both = np.minimum((signs > 0).mean(axis=0), (signs < 0).mean(axis=0)) > 0.05
    joints = np.flatnonzero(suspects & both & (ratio < GEOMETRY.unsigned_gain))
    if not len(joints):
        return []
    where = f"joint {', '.join(repr(problem.arm.joint_names[k]) for k in joints)}, tau"
    got = (
        "torques without sign: they keep one direction, although the motion needs both (with signs, the squared torque "
        f"error of least squares falls to {ratio[joints].max():.1%})"
    )
    do, codes = "log torques or currents with their sign", (UNSIGNED,)
    return [LogError(got, element=where, expected="torques in both directions", do=do, codes=codes)]


def find_limits(problem: GeometryProblem, flat: FlatTops) -> Findings:
    """Return an error for each joint with clipped torques; if there is none, a warning for each joint at a stop.

    At a stop, a position is constant at an extreme while the torque contradicts the model. problem: least-squares
    problem of the logs. flat: flat tops of the logs as recorded, since a low-pass filter rounds flat tops off.
    """
    problem, findings = problem.thinned(GEOMETRY.confirming_samples), Findings()
    samples = problem.unchanged.signals(problem.samples)
    at_torque, at_position = (_at_levels(*x) for x in ((flat.tau, samples.tau), (flat.q, samples.motion[0])))
    free = ~(at_torque | at_position).any(axis=0)
    if free.all():
        return findings
    # The model is fitted only to samples outside flat tops: at these samples, neither torque nor position is at a
    # limit.
    fit = problem.on_torques(free).fit(problem.unchanged)
    residual = problem.residual(problem.unchanged, fit.parameters)
    deviation, (_, _, friction, *_) = problem.prediction_deviation(fit), problem.drive_parameters(fit)
    # A fit to few samples has a smaller residual than the noise. The sum of squares is divided by the number of samples
    # minus 30, about the number of parameters that are fitted to a joint's torque.
    freedom = np.maximum(free.sum(axis=0) - 30, 1e-9)
    noise = np.sqrt(np.square(residual * free).sum(axis=0) / freedom)
    certain = 3.0  # number of standard deviations that a significant difference exceeds
    for k, coordinate in enumerate(problem.arm.coordinates):
        unit, levels = UNITS[coordinate.joint_type].torque, flat.tau[:, k]
        sides = zip(SIDES, at_torque[..., k], strict=True)
        doubt = certain * deviation[:, k]
        excess = np.array([_median((side * residual[:, k] - doubt)[rows]) for side, rows in sides])
        # `excess` is the median, over the samples at a flat top (or bottom), by which the model's torque exceeds the
        # logged torque. The torques are clipped there if it is above `sure`, which is at least the joint's friction: in
        # few samples, the estimated friction may be wrong by 100 %.
        sure = max(certain * noise[k], 0.08 * samples.tau[:, k].std(), abs(friction[k]))
        is_clipped = excess > sure
        if is_clipped.any():
            limits = " and ".join(f"{x:.4g}" for x in levels[is_clipped])
            needed = np.abs(residual + samples.tau)[at_torque[is_clipped, :, k].any(axis=0), k].max()
            got = (
                f"torques that stop at {limits} {unit} in {flat.shares[is_clipped, k].sum():.1%} of the "
                f"samples, in which the motion needs up to {needed:.4g} {unit} by least squares on the others"
            )
            where, expected = f"joint {coordinate.name!r}, tau", "the torques that moved it"
            do = "log torques without this limit, or record slower motion"
            findings.errors.append(LogError(got, element=where, expected=expected, do=do, codes=(CLIPPED,)))
    for k, coordinate in enumerate(problem.arm.coordinates if not findings.errors else ()):
        for level, rows in zip(flat.q[:, k], at_position[..., k], strict=True):
            difference = _median((np.abs(residual) - certain * deviation)[rows, k])
            # `difference` is between logged torque and torque of the model, while the position is at an extreme. A
            # joint counts as pushed against a stop only if the difference is large. Smaller differences also occur in
            # pauses of a joint that moves only in one direction: such motion does not determine the friction, so that
            # the torque of the model is wrong by about the friction when the joint is at rest.
            sure = max(certain * noise[k], 0.5 * samples.tau[:, k].std())
            if difference > sure + 2 * abs(friction[k]):
                message = (
                    f"q stays at {level:.4g} while its torque differs by {difference:.3g} from the model of the other "
                    "samples: contact with a stop; remove such motion"
                )
                where = f"joint {coordinate.name!r}"
                findings.notes.append(Diagnostic("warning", AT_A_STOP, where, None, message))
    return findings


def _at_levels(levels: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return a mask (2, S, n) of the samples at which filtered signals `values` (S, n) are at a flat bottom or top.

    levels: (2, n) values of the flat bottoms and tops; the mask is False for NaN.
    """
    distance = SIDES[:, None, None] * (levels[:, None] - values)
    return np.asarray(distance < 0.02 * np.ptp(values, axis=0))


def _median(values: Sequence[float] | np.ndarray) -> float:
    """Return the median of values (S,); minus infinity if there are none."""
    return float(np.median(values)) if len(values) else -np.inf
