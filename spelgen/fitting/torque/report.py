"""Notes about a torque fit for users: prior width, selected residual terms, undetermined inertias."""

import math
from collections.abc import Iterator
from itertools import compress

import numpy as np
from scipy.special import gammaincinv

from spelgen.dynamics.parameters import idle_residuals
from spelgen.dynamics.protocol import residual_terms
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic
from spelgen.fitting.posterior import Posterior
from spelgen.fitting.torque.fit import FitComparison, TorqueSolution
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.tuning import TUNING
from spelgen.identification.drive_hints import friction_compensated
from spelgen.runtime.motors import MotorInputs

TERM_NAMES = {
    "raw_torque_splines": "a torque by position (spring, cable)",
    "raw_torque_ripple": "a torque that repeats with the turn (ripple, cogging)",
    "raw_friction_splines": "friction that varies with position",
    "residual_potential": "a network in V",
    "residual_mass": "networks in M",
}


def torque_notes(model: ArmModel, samples: TorqueSamples, solution: TorqueSolution) -> Iterator[Diagnostic]:
    """Yield the notes about a fit of a rigid-body model to samples."""
    names = np.array(model.joint_names)
    posterior = Posterior(model, solution.covariance, solution.torque_std.numpy())
    yield _urdf_prior(solution)
    if solution.prior.offset >= TUNING.max_width:
        yield _warning(
            "offset-prior",
            "the torque offsets exceed three times the friction that is expected of drives of this effort; check the "
            "effort limits of the URDF, the zeros of the torques and their unit",
        )
    nmse = _likely_nmse(samples, solution)
    if (nmse > TUNING.unsupported).any():
        yield _few_data(samples, nmse, names, solution.comparison)
    if solution.comparison is not None:
        yield from _behind_simpler_methods(solution.comparison)
    if isinstance(model.inputs, MotorInputs) and len(model.inputs.gain_rows):
        yield _trained_gains(posterior)
    if solution.compensated.any():
        value = model.friction_compensation.tolist()
        joints = ", ".join(
            f"{names[k]} {value[k]:.3g}" for k in np.flatnonzero(solution.compensated) if value[k] > 0
        )
        yield friction_compensated(f"{joints} Nm s/rad (N s/m) are added")
    if residual_terms(model) is not None:
        yield Diagnostic("info", "residuals", "model", None, _selected_terms(samples, solution, names))
    # A few positions suffice for the mean inertia, the mean diagonal of M, (n,) [kg m^2, kg].
    subset = samples.subsampled(50).columns
    inertia, std = posterior.uncertain(
        lambda fitted: fitted.mass_matrix(subset.q).diagonal(dim1=-2, dim2=-1).mean(dim=0)
    )
    undetermined = std > TUNING.undetermined * inertia
    if undetermined.any():
        joints = ", ".join(names[undetermined])
        message = f"these logs do not determine the inertia at {joints}; its value is mostly the prior"
        yield _warning("inertia-undetermined", message)
    weak = solution.rms_residual > TUNING.weak_acceleration * inertia * subset.qdd.std(dim=0).numpy()
    if weak.any():
        yield _warning(
            "acceleration-unseen",
            f"the torque residual exceeds the inertial torque at {', '.join(names[weak])}: a simulation may be worse "
            "than constant velocity; record faster motion",
        )


def _warning(code: str, message: str, element: str = "logs") -> Diagnostic:
    return Diagnostic("warning", code, element, None, message)


def _urdf_prior(solution: TorqueSolution) -> Diagnostic:
    """Return a note with the typical factor by which masses in the URDF are wrong, or a warning if it is too large.

    The logarithm of the factor is the prior standard deviation of the bodies' parameters, estimated in the fit.
    """
    # `prior.bodies` is the standard deviation of each log-Cholesky parameter. One of the ten parameters of a body is
    # the logarithm of the mass, so exp(standard deviation) is a factor of the mass.
    factor = float(np.exp(solution.prior.bodies))
    message = f"prior standard deviation of URDF masses: factor {factor:.2g}"
    if factor <= TUNING.wrong_urdf:
        return Diagnostic("info", "urdf-prior", "bodies", None, message)
    if solution.prior.bodies >= TUNING.max_width:
        message += (
            ", its upper bound: the masses of the URDF are wrong by more, or the torques are not in Nm (N); "
            "`spelgen logs` tests their units"
        )
    else:
        message += (
            "; check the masses and centres of mass of the URDF, `spelgen logs` names links that are far off"
        )
    return _warning("urdf-prior", message, "bodies")


def _likely_nmse(samples: TorqueSamples, solution: TorqueSolution) -> np.ndarray:
    """Return a median-unbiased nMSE of held-out blocks, (n,): it is too small or too large with equal probability.

    The mean of few squared errors is more often too small than too large. The sum of all squared errors is assumed to
    be chi-squared with one degree of freedom per `TUNING.segment`, one second, since errors of models are correlated
    over such times. The nMSE is multiplied by (degrees of freedom) / (median of this distribution).
    """
    seconds = samples.count * samples.interval / TUNING.segment
    # The number of seconds is the number of degrees of freedom of the chi-squared distribution, `median` is its median.
    # The nMSE is multiplied by seconds / median: by 1.27 for three seconds of motion and by 1.06 for twelve, so that
    # the correction is important only for short logs.
    median = 2 * float(gammaincinv(seconds / 2, 0.5))
    return solution.held_out_nmse * seconds / median


def _few_data(
    samples: TorqueSamples, nmse: np.ndarray, names: np.ndarray, comparison: FitComparison | None
) -> Diagnostic:
    """Return the warning that the logs have too little motion for the parameters of some joints.

    nmse: (n,), nMSE of held-out blocks from `_likely_nmse`. names: (n,), names of the joints. comparison: comparison
    with ridge regression, whose nMSE the text also states; None: there is no such comparison.
    """
    seconds, joints = samples.count * samples.interval, ", ".join(names[nmse > TUNING.unsupported])
    # The recommended duration assumes that the nMSE is inversely proportional to the duration of the motion. It is at
    # most a minute, which is enough for the recorded arms: if an nMSE remains large after a minute, the cause is not
    # the duration.
    enough = min(math.ceil(seconds * float(np.nanmax(nmse)) / TUNING.unsupported), 60)
    advice = f"record about {enough} s in which all joints move"
    if enough <= seconds:
        advice = "a longer log would not help: `spelgen logs` tests units and signs, `spelgen excite` plans a motion"
    ridge = "" if comparison is None else f" (nMSE {comparison.regression:.2g}, mean over joints)"
    return _warning(
        "few-data",
        f"torques that were not fitted are predicted no better than by a constant at {joints} "
        f"(nMSE {np.nanmax(nmse):.2g}): {seconds:.2g} s of this motion do not support a fit, the values of the URDF or "
        f"of a ridge regression{ridge} may be as good; {advice}",
    )


def _behind_simpler_methods(comparison: FitComparison) -> Iterator[Diagnostic]:
    """Yield a warning if ridge regression or the URDF's values predicted held-out torques better than the fit."""
    regression = f"ridge regression (nMSE {comparison.regression:.2g})"
    if comparison.discarded is not None:
        yield _warning(
            "fit-discarded",
            "the model keeps the inertials of the URDF and typical friction: they predict torques that were not fitted "
            f"(nMSE {comparison.fit:.2g}) as well as a fit to these logs (nMSE {comparison.discarded:.2g}) or "
            "better; record more motion",
        )
    if comparison.replaced is not None:
        yield _warning(
            "fit-from-regression",
            f"from the inertials of the URDF the fit predicts torques that were not fitted worse than {regression}: "
            f"nMSE {comparison.replaced:.2g}. The result is a fit from the regression's values, without the URDF's "
            f"inertials: nMSE {comparison.fit:.2g}. Check masses and centres of mass in the URDF, and their units",
        )
    if comparison.behind:
        yield _warning(
            "behind-regression",
            f"{regression} predicts torques that were not fitted better than physically consistent bodies "
            f"(nMSE {comparison.fit:.2g}); check the units of the torques, couplings of motors and the URDF: "
            "`spelgen logs` tests them",
        )


def _trained_gains(posterior: Posterior) -> Diagnostic:
    """Return a note with the motor gains and their 95 % intervals, or a warning if logs do not determine a gain."""
    gains = posterior.drives["gain"]
    parts = [f"{x.name} {x.value:.4g} ({x.low:.4g} to {x.high:.4g})" for x in gains]
    message = f"joint torque per logged torque, with 95 % intervals: {', '.join(parts)}"
    undetermined = [x.name for x in gains if x.std > TUNING.undetermined_gain * x.value]
    if not undetermined:
        return Diagnostic("info", "trained-gains", "motors", None, message)
    message += (
        f"; the gain of {', '.join(undetermined)} is not determined: friction and inertia scale with it"
    )
    return _warning("trained-gains", message, "motors")


def _selected_terms(samples: TorqueSamples, solution: TorqueSolution, names: np.ndarray) -> str:
    """Return a sentence with the selected residual terms and their error reductions."""
    if not solution.selected_terms:
        return "no residual terms selected (cross-validation)"
    parts = []
    for term in solution.selected_terms:
        joint = "" if term.joint is None else f" at {names[term.joint]}"
        parts.append(f"{TERM_NAMES[term.name]}{joint} ({term.error_reduction:.1%})")
    if not samples.recordings.any():
        parts[-1] += "; all of them were selected in one recording: test them on another motion"
    heading = "residual terms selected by cross-validation, with the decrease of squared torque residuals: "
    return heading + ", ".join(parts)


def terms_in_use(model: ArmModel) -> list[str]:
    """Return a text for each nonzero residual term of a model, with the joints on which the term acts."""
    names = model.joint_names
    residuals = residual_terms(model)
    if residuals is None:
        return []
    idle = idle_residuals(model)
    terms: list[str] = []
    for name, weights in residuals.named_parameters():
        if f"residuals.{name}" in idle:
            continue
        if name in TERM_NAMES:
            joints = compress(names, weights.any(dim=1).tolist())
            term = f"{TERM_NAMES[name]} at {', '.join(joints)}"
        elif name.startswith("potential."):
            term = TERM_NAMES["residual_potential"]
        else:
            term = TERM_NAMES["residual_mass"]
        if term not in terms:
            terms.append(term)
    return terms
