"""Integrate an arm's motion under held torques, as exact as floating-point numbers allow.

    M(q) qdd + nonlinear_effects(q, qd) = tau - friction(qd)        tau held between samples

Joint limits are not enforced: there are no end stops.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import DOP853, LSODA

from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.errors import RunError
from spelgen.settings.tuning.simulation import SimulationTuning
from spelgen.simulation.friction import Friction

TUNING = SimulationTuning()
LOOSER = TUNING.check_loosening


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
    the next sample, LSODA (Petzold, SIAM J. Sci. Stat. Comput. 4, 1983), which is not held to steps as short as that.
    looser: factor on the error allowed. Raises RunError where it cannot go on.
    """
    n = tau.shape[1]
    # encoders see it: exact to 1e-9, for 1e-13 takes ten times as long (measured)
    stiff_looser = LOOSER**2 * looser
    states = np.empty((t.size, 2 * n))
    states[0] = start
    stiff = _decay(dynamics, friction, start[:n]) * np.diff(t).max(initial=0.0) > TUNING.stiff

    def derivative(_: float, state: np.ndarray) -> np.ndarray:
        qd = state[n:]
        return np.concatenate([qd, dynamics.forward_dynamics(state[:n], qd, torque - friction(qd))])

    for k in range(t.size - 1):
        torque = tau[k]
        span = (derivative, t[k], states[k], t[k + 1])
        if stiff:
            tolerances = {"rtol": TUNING.rtol * stiff_looser, "atol": TUNING.atol * stiff_looser}
            states[k + 1] = _finish_stiff(LSODA(*span, **tolerances))
            continue
        solver = DOP853(*span, rtol=TUNING.rtol * looser, atol=TUNING.atol * looser)
        _finish(solver, friction.widths, stretch=looser**0.125)  # as error control lengthens steps of order 8
        states[k + 1] = solver.y
    return states


def _decay(dynamics: PinocchioDynamics, friction: Friction, q: np.ndarray) -> float:
    """Return how fast friction stops joints near rest [1/s]: the largest eigenvalue of M^-1 d friction / d qd."""
    slope = friction.viscous + (friction.forward - friction.backward) / (2 * friction.smoothing_velocity)
    try:
        rates = np.linalg.eigvals(np.linalg.solve(dynamics.mass_matrix(q), np.diag(slope)))
    except np.linalg.LinAlgError:  # no M: the integration will say so
        return 0.0
    return float(np.abs(rates).max(initial=0.0))


def _finish_stiff(solver: LSODA) -> np.ndarray:
    """Return the state (2n,) at the end of a solver's interval."""
    failure = None
    while solver.status == "running" and failure is None:
        failure = solver.step()
        failure = failure if np.isfinite(solver.y).all() else "a velocity is not finite"
    if failure is not None:
        raise _stuck(solver.t, failure)
    return np.asarray(solver.y)


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
