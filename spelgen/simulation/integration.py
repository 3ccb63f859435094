"""Integrate an arm's motion under held torques, as exact as floating-point numbers allow.

    M(q) qdd + nonlinear_effects(q, qd) = tau - friction(qd)        tau held between samples

Joint limits are not enforced: there are no end stops.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from scipy.integrate import DOP853, ODEintWarning, odeint

from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.errors import RunError
from spelgen.settings.tuning.simulation import SimulationTuning
from spelgen.simulation.friction import Friction

TUNING = SimulationTuning()
LOOSER = TUNING.check_loosening
SEEN = LOOSER**1.5
"""Factor on tolerances where encoders see a motion: 1e-10 is enough, and 1e-13 takes three to five times as long."""


def rollout(
    dynamics: PinocchioDynamics,
    friction: Friction,
    start: np.ndarray,
    t: np.ndarray,
    tau: np.ndarray,
    looser: float = 1.0,
) -> np.ndarray:
    """Return the states (q, qd), (T, 2n), at the times t (T,) [s] from a start (2n,) under tau (T, n).

    Dormand-Prince 8(5,3), begun anew at every sample because tau jumps there; where friction stops a joint long before
    the next sample, or errors may be larger, LSODA (Petzold, SIAM J. Sci. Stat. Comput. 4, 1983), which is not held to
    steps as short as that, begun anew where tau changes. looser: factor on the error allowed, `SEEN` and beyond where
    encoders see the motion. Raises RunError where it cannot go on.
    """
    n = tau.shape[1]
    stiff = _decay(dynamics, friction, start[:n]) * np.diff(t).max(initial=0.0) > TUNING.stiff
    if stiff and looser < SEEN:
        looser *= SEEN
    states = np.empty((t.size, 2 * n))
    states[0] = start
    changes = np.arange(1, t.size - 1)
    if looser >= SEEN:
        changes = changes[(tau[1:-1] != tau[:-2]).any(axis=1)]
    for first, last in pairwise([0, *changes.tolist(), t.size - 1]):
        torque = tau[first]

        def derivative(_: float, state: np.ndarray, torque: np.ndarray = torque) -> np.ndarray:
            qd = state[n:]
            return np.concatenate([qd, dynamics.forward_dynamics(state[:n], qd, torque - friction(qd))])

        if looser >= SEEN:
            states[first : last + 1] = _finish_stiff(derivative, states[first], t[first : last + 1], looser)
            continue
        solver = DOP853(
            derivative, t[first], states[first], t[last], rtol=TUNING.rtol * looser, atol=TUNING.atol * looser
        )
        _finish(solver, friction.widths, stretch=looser**0.125)  # as error control lengthens steps of order 8
        states[last] = solver.y
    return states


def _decay(dynamics: PinocchioDynamics, friction: Friction, q: np.ndarray) -> float:
    """Return how fast friction stops joints near rest [1/s]: the largest eigenvalue of M^-1 d friction / d qd."""
    try:
        rates = np.linalg.eigvals(np.linalg.solve(dynamics.mass_matrix(q), friction.damping_at_rest()))
    except np.linalg.LinAlgError:  # no M: the integration will say so
        return 0.0
    return float(np.abs(rates).max(initial=0.0))


def _finish_stiff(
    derivative: Callable[[float, np.ndarray], np.ndarray], start: np.ndarray, t: np.ndarray, looser: float
) -> np.ndarray:
    """Return the states (T, 2n) at the times t (T,) [s], the start's included, while tau is held."""
    tolerances = {"rtol": TUNING.rtol * looser, "atol": TUNING.atol * looser}
    with warnings.catch_warnings():
        warnings.simplefilter("error", ODEintWarning)
        try:
            states = odeint(derivative, start, t, tfirst=True, mxstep=TUNING.most_steps, **tolerances)
        except ODEintWarning as warning:
            raise _stuck(t[0], str(warning).split(" (")[0].lower()) from warning
    if not np.isfinite(states).all():
        raise _stuck(t[0], "a velocity is not finite")
    return np.asarray(states)


def _stuck(t: float, failure: str) -> RunError:
    cure = "check the inertials; make simulation.duration smaller or simulation.coulomb_smoothing_velocity larger"
    return RunError(f"the motion cannot be integrated beyond t = {t:g} s: {failure}", do=cure)


def _finish(solver: DOP853, widths: np.ndarray, stretch: float) -> None:
    """Carry a solver of (q, qd) to the end of its interval.

    No step may change a velocity by much more than a quarter of it, or of the width (n,) of its joint's
    friction jump if that is more, times stretch: friction is flat beyond the jump, and the error control
    would not see a reversal between the stages of a long step.
    """
    n, failure = widths.size, None
    while solver.status == "running" and failure is None:
        slope = np.max(np.abs(solver.f[n:]) / np.maximum(widths, np.abs(solver.y[n:])))
        solver.max_step = 0.25 * stretch / slope if slope > 0 else np.inf
        # the step-size control would never come back from a nan
        failure = solver.step() if np.isfinite(solver.f).all() else "an acceleration is not finite"
    if failure is not None:
        raise _stuck(solver.t, failure)
