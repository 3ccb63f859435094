"""Integrate an arm's motion under held torques, as exact as floating-point numbers allow.

    M(q) qdd + nonlinear_effects(q, qd) = tau - friction(qd)        tau held between samples

Joint limits are not enforced: there are no end stops.
"""

from __future__ import annotations

import warnings
from itertools import pairwise

import numpy as np
from scipy.integrate import ODEintWarning, odeint

from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.errors import RunError
from spelgen.simulation.tuning import TUNING


def rollout(
    dynamics: PinocchioDynamics,
    start: np.ndarray,
    t: np.ndarray,
    tau: np.ndarray,
    looser: float = 1.0,
) -> np.ndarray:
    """Return the states (q, qd), (T, 2n), at the times t (T,) [s] from a start (2n,) under tau (T, n).

    LSODA (Petzold, SIAM J. Sci. Stat. Comput. 4, 1983), which friction that stops a joint at once does not hold to
    short steps, begun anew where tau changes. looser: factor on the error allowed. Raises RunError where it cannot go
    on.
    """
    n = tau.shape[1]
    tolerances = {"rtol": TUNING.rtol * looser, "atol": TUNING.atol * looser}
    states = np.empty((t.size, 2 * n))
    states[0] = start
    changes = np.flatnonzero((tau[1:-1] != tau[:-2]).any(axis=1)) + 1
    for first, last in pairwise([0, *changes.tolist(), t.size - 1]):
        torque = tau[first]

        def derivative(_: float, state: np.ndarray, torque: np.ndarray = torque) -> np.ndarray:
            qd = state[n:]
            return np.concatenate([qd, dynamics.forward_dynamics(state[:n], qd, torque)])

        if not np.isfinite(derivative(0.0, states[first])).all():
            raise _stuck(t[first], "an acceleration is not finite")
        span = slice(first, last + 1)
        with warnings.catch_warnings():
            warnings.simplefilter("error", ODEintWarning)
            try:
                states[span] = odeint(
                    derivative,
                    states[first],
                    t[span],
                    tfirst=True,
                    mxstep=TUNING.most_steps,
                    **tolerances,
                )
            except ODEintWarning as warning:
                raise _stuck(t[first], str(warning).split(" (")[0].lower()) from warning
        if not np.isfinite(states[last]).all():
            raise _stuck(t[first], "a velocity is not finite")
    return states


def _stuck(t: float, failure: str) -> RunError:
    cure = "check the inertials; make simulation.duration smaller or simulation.coulomb_smoothing_velocity larger"
    return RunError(f"the motion cannot be integrated beyond t = {t:g} s: {failure}", do=cure)
