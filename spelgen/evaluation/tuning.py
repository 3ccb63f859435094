"""Constants of the evaluation and of its report."""

from dataclasses import dataclass


@dataclass(frozen=True)
class EvaluationTuning:
    """Constants of an evaluation: windows and horizons, thresholds of the assessment in words, resolution of curves."""

    # [s] Time that the momentum observer runs before a prediction; with 0.2 and 0.3 s, predictions of the UR10e of
    # `benchmarks/arms.py` are no better.
    observed_past: float = 0.1
    # [s] Time constant 1 / K of the momentum observer with the gain K. On the UR10e of `benchmarks/arms.py`, the errors
    # of the predictions that use the observer vary by 3 % between time constants of 0.02 and 0.1 s.
    observer_time_constant: float = 0.05
    # [1] Largest number of windows per horizon. The windows are evenly spread over the logs.
    most_windows: int = 1000
    # [1] Largest number of predicted steps per predictor and horizon. A horizon of k steps has this number / k windows,
    # but at least `fewest_windows`.
    most_predicted_steps: int = 10_000
    # [1] Smallest number of windows per horizon. The number of windows falls with the length of the horizon (see
    # `most_predicted_steps`), but not below this value unless the logs are too short.
    fewest_windows: int = 100
    # [1] Number of test windows from which the number of integration steps of a model is chosen.
    probed_model_windows: int = 64
    # [1] Fraction of the torque variance that a model must explain for contact detection. No standard specifies this
    # fraction; it is a choice of the package, like the next two.
    explained_for_contacts: float = 0.99
    # [1] Fraction of the torque variance that a model must explain for feed-forward control.
    explained_for_feed_forward: float = 0.95
    # [1] Fraction of the torque variance that a model must explain for gravity compensation. On most logs gravity and
    # friction explain about this fraction, so a model that explains less has errors in gravity or friction.
    explained_for_gravity: float = 0.8
    # [1] Largest relative prediction error (RMS error / RMS change of q and qd over the horizon) for which the
    # assessment recommends simulation.
    close_prediction: float = 0.1
    # [1] Largest relative prediction error (RMS error / RMS change of q and qd over the horizon) for which the
    # assessment recommends rough simulation.
    rough_prediction: float = 0.3
    # [rad, m] Logs contain no motion if the range of positions of each joint is below this number.
    smallest_motion: float = 0.01
    # [1] Logs that cover less than this fraction of a joint's range are reported as narrow.
    narrow_range: float = 0.5
    # [1] Approximate number of test positions at which M is compared with the true M.
    mass_positions: int = 500
    # [1] Largest number of words of the first sentence of an assessment.
    headline: int = 20
    # [samples] Length of the windows from which the number of integration steps is chosen: the default length of the
    # windows of a fit.
    model_window: int = 5
    # [s] Length of the windows that are replayed from a measured state.
    replay_window: float = 1.0

    # The following constants are the resolution of the curves of a report.

    # [s] Length of the part of a log of which charts show the torques.
    torque_seconds: float = 10.0
    # [1] Number of samples of a curve along a part of a log or along a prediction.
    curve_samples: int = 240
    # [1] Number of samples of a curve along a log that is replayed as a whole.
    log_samples: int = 600
    # [1] Number of times in the chart of errors over the prediction horizon.
    curve_times: int = 24


TUNING = EvaluationTuning()
