"""Integration of the equation of motion under piecewise constant torques, to the accuracy of floating-point numbers.

    M(q) qdd + nonlinear_effects(q, qd) = tau - friction(qd)        with tau constant between samples

Joint limits are not enforced: there are no end stops.
"""

import warnings
from itertools import pairwise

import numpy as np
from scipy.integrate import ODEintWarning, odeint

from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.errors import RunError
from spelgen.simulation.tuning import TUNING


def rollout(
    dynamics: PinocchioDynamics,
    initial: np.ndarray,
    t: np.ndarray,
    tau: np.ndarray,
    tolerance_factor: float = 1.0,
) -> np.ndarray:
    """Return the states (q, qd) of a simulated motion at times t, (T, 2n) [rad, rad/s; m, m/s].

    Method: LSODA (Petzold, SIAM J. Sci. Stat. Comput. 4, 1983), restarted at each change of tau. LSODA switches to an
    implicit method for stiff friction, so a joint that stops within microseconds does not force short steps. Raises
    RunError if the integration fails.

    Args:
        dynamics: The arm, with friction.
        initial: State (2n,) at t[0].
        t: Times (T,) [s].
        tau: Joint torques (T, n) [Nm, N]; tau[k] acts from t[k] to t[k+1].
        tolerance_factor: Factor of the default relative and absolute tolerances.
    """
    n = tau.shape[1]

    def derivative(_: float, state: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the derivative of the state (q, qd), (2 n,), under a constant torque (n,) [Nm, N]."""
        qd = state[n:]
        return np.concatenate([qd, dynamics.forward_dynamics(state[:n], qd, torque)])

    rtol, atol = TUNING.rtol * tolerance_factor, TUNING.atol * tolerance_factor
    options = {"rtol": rtol, "atol": atol, "tfirst": True, "mxstep": TUNING.most_steps}
    states = np.empty((t.size, 2 * n))
    states[0] = initial
    # LSODA is a multistep method: it extrapolates from past derivatives, which are invalid after a jump of tau.
    # Therefore LSODA is restarted at each jump.
    changes = np.flatnonzero((tau[1:-1] != tau[:-2]).any(axis=1)) + 1
    for first, last in pairwise([0, *changes.tolist(), t.size - 1]):
        if not np.isfinite(derivative(0.0, states[first], tau[first])).all():
            raise _stuck(t[first], "an acceleration is not finite")
        span = slice(first, last + 1)
        with warnings.catch_warnings():
            warnings.simplefilter("error", ODEintWarning)
            try:
                states[span] = odeint(derivative, states[first], t[span], (tau[first],), **options)
            except ODEintWarning as warning:
                raise _stuck(t[first], str(warning).split(" (")[0].lower()) from warning
        if not np.isfinite(states[last]).all():
            raise _stuck(t[first], "a velocity is not finite")
    return states


def _stuck(t: float, failure: str) -> RunError:
    """Return the error for an integration that failed at time t [s]. failure: reason of the failure."""
    cure = "check the inertials; make simulation.duration smaller or simulation.coulomb_smoothing_velocity larger"
    return RunError(f"the motion cannot be integrated beyond t = {t:g} s: {failure}", do=cure)
