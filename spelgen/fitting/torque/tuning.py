"""Constants of fits to torques."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from spelgen.settings.fits import Adaptation, GaussianPrior

# [1] Standard deviations of the friction parameters of one arm on different days, as options of `GaussianPrior`.
DAY_TO_DAY = {
    "sizes": 0.1,
    "velocities": 0.1,
    "fractions": 0.1,
    "shared_sizes": 0.1,
    "shared_velocities": 0.1,
    "shared_fractions": 0.1,
    "shared_friction": 0.3,
}


@dataclass(frozen=True)
class TorqueTuning:
    """Constants of fits of rigid-body models to torques (`fitting.torque`)."""

    # [1] Only every second sample is used. Samples have a common rate of 100 Hz; after the low-pass filter at 8 Hz, 50
    # samples per second contain all information.
    decimation: int = 2
    # [s] Prior mean of the correlation time of torque errors, from recordings of arms. Samples within a correlation
    # time count as one independent error.
    correlation_time: float = 0.2
    # [s] Correlation time of torque errors in comparisons of friction models. Two friction models differ only for a
    # short time after each reversal of velocity, so their difference is correlated for less than `correlation_time`.
    reversal_correlation_time: float = 0.1
    # [1] Weight of the prior mean `correlation_time` in the estimated correlation time, as a number of independent
    # errors.
    correlation_weight: float = 30.0
    # [s] Duration of the segments from which the correlation time is estimated.
    segment: float = 1.0
    # [1] Upper bound of an estimated prior standard deviation: for the logarithms of masses and armatures, 3 is a
    # factor of exp(3) = 20; for torque offsets, 3 is three times the typical friction. Logs that need more are of
    # another arm than the URDF, or not in Nm.
    max_width: float = 3.0
    # [1] Largest number of outer iterations; each makes Levenberg-Marquardt steps and then updates noise and prior.
    iterations: int = 20
    # [1] Evidence, twice the logarithm of a likelihood ratio, that counts as strong (Kass and Raftery, J. Am. Stat.
    # Assoc. 90:773, 1995).
    strong_evidence: float = 6.0
    # [1] Largest number of Levenberg-Marquardt steps after noise annealing, before the first update of noise and prior.
    initial_steps: int = 60
    # [1] Largest number of iterations of noise annealing, which lowers the noise to the least-squares noise.
    annealing_iterations: int = 12
    # [1] Noise in the iterations of noise annealing, as a fraction of the rms torque residual. For a low_cost_robot
    # with placeholder inertials, annealing reduces the relative error of the mass matrix M(q) from 0.44 to 0.005.
    annealing_fraction: float = 0.03
    # [1] The noise has converged if its ratio to the noise of the previous iteration exceeds this value.
    noise_converged: float = 0.98
    # [1] Largest number of Levenberg-Marquardt steps between two updates of the noise, in an outer iteration or in an
    # iteration of noise annealing.
    iteration_steps: int = 5
    # [1] Levenberg-Marquardt steps end early if a step lowers the cost by less than this fraction.
    min_relative_decrease: float = 1e-4
    # [1] Number of alternations between the fits of rigid bodies and of residual terms, after the selection of the
    # terms.
    alternations: int = 3
    # [1] Number of evenly spaced samples in the stages before the selection of residual terms; the final fit uses all.
    initial_samples: int = 2**10
    # [1] Largest number of windows of 5 samples from which the scales of the validation loss are computed.
    max_windows: int = 2**12
    # [1] Largest number of windows on which the fitted model is validated.
    validation_windows: int = 2**8
    # [1] Largest number of samples for the selection of residual terms.
    residual_samples: int = 2**14
    # [1] Lower bound of the noise, as a fraction of the torque's standard deviation, for samples without noise.
    min_noise: float = 1e-4
    # [1] Friction compensation of a drive is detected only if the slope of the torque residual over velocity differs
    # from zero by this number of its standard deviations.
    min_significance: float = 4.0
    # [1] A friction compensation is detected only if the standard deviation of its torque exceeds this fraction of the
    # torque's standard deviation. Delays of milliseconds between torque and motion have a similar but smaller effect on
    # the residual.
    min_compensation: float = 0.05
    # [1] Number of samples per block in computations of the torque Jacobian: a block and its derivatives need some 100
    # MB of memory for seven joints.
    block: int = 2**13
    # [B] Memory of the regressors, which limits the number of samples to 70,000 for six joints. Larger logs are
    # subsampled.
    regressor_bytes: float = 4e8
    # [1] Largest step of a body's inertial parameters, as a fraction of the step that would make them physically
    # inconsistent.
    body_step: float = 0.3
    # [1] A warning names inertias whose relative standard deviation exceeds this value.
    undetermined: float = 0.5
    # [1] A warning names motor gains whose relative standard deviation exceeds this value. The 95 % interval is then
    # wider than +-20 %, a typical difference between two datasheets.
    undetermined_gain: float = 0.1
    # [1] A warning names joints whose nMSE of held-out blocks exceeds this value. If the mean nMSE does, a fit that is
    # not better than the URDF is discarded.
    unsupported: float = 0.5
    # [1] The masses of a URDF are implausible if exp(estimated prior standard deviation of the logarithms of the
    # masses) exceeds this factor. The fit then tries friction compensation at all joints, and a warning is issued.
    wrong_urdf: float = 5.0
    # [1] A warning names joints whose RMS torque residual divided by the RMS inertial torque exceeds this value: their
    # predicted motion is unreliable.
    weak_acceleration: float = 2.0
    # [1] Prior standard deviations of an adapted fit, for each value of the option `adapt`; the prior mean is the
    # source fit. load: exp(3) is a factor of twenty for the mass. A larger standard deviation is too wide for short
    # logs: with 10, a fit to half a second of motion of a UR10e predicts torques with an nMSE of 27. friction:
    # temperature changes the common factor of all joints by tens of per cent, the factors of single joints by less
    # (Bittencourt and Gunnarsson, J. Dyn. Sys. Meas. Control 134:051013, 2012). unit: arms of the same type also differ
    # in mass, by a few per cent.
    priors: Mapping[Adaptation, GaussianPrior] = field(
        default_factory=lambda: {
            "load": GaussianPrior(bodies=3.0),
            "friction": GaussianPrior(**DAY_TO_DAY),
            "unit": GaussianPrior(**DAY_TO_DAY, bodies=0.1, gains=0.1, armature=0.1, shared_armature=0.1),
        }
    )


@dataclass(frozen=True)
class ResidualTuning:
    """Constants of the selection of residual terms (`fitting.torque.selection`)."""

    # [1] Number of contiguous blocks of samples, each of which is held out once.
    folds: int = 10
    # [1] Gap between fitted and held-out samples, divided by the correlation time of the torque errors.
    gap: float = 2.5
    # [1] A residual term is accepted only if the t value of its mean error reduction over the blocks exceeds this
    # number: p = 0.01 for Student's t with nine degrees of freedom.
    standard_errors: float = 2.82
    # [1] The bound that replaces `standard_errors` if there are only one or two recordings: p = 0.001. It is stricter,
    # since the held-out motion may then be similar to the fitted motion, so that both have the same errors of the
    # model. A term that explains such errors need not be right for other motion.
    standard_errors_of_one: float = 4.30
    # [1] Largest standard deviation of a position-dependent torque that is selected on one or two recordings, as a
    # fraction of the standard deviation of the joint's torque.
    max_torque_fraction: float = 0.5
    # [1] Smallest standard deviation of a joint's gravity torque for which a spring at this joint is plausible, as a
    # fraction of the standard deviation of the joint's torque.
    min_load_fraction: float = 0.1
    # [1] A residual term is selected only if it reduces the held-out squared torque residual by at least this fraction.
    min_reduction: float = 1e-3
    # [1] A candidate replaces the best previous candidate of a joint only if its held-out squared residual is below
    # this fraction of the previous one. The order of the candidates is splines, friction factor, ripple.
    preference_ratio: float = 0.9
    # [1] Largest number of samples to which networks are fitted.
    network_samples: int = 2**12
    # [1] Number of evaluations of the loss after which a network is discarded if it does not reduce the error.
    network_probe_evaluations: int = 20
    # [1] Number of evaluations of the loss in the fit of a network.
    network_evaluations: int = 100


TUNING = TorqueTuning()
SELECTION = ResidualTuning()
