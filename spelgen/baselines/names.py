"""The names of predictors, in results, charts and tables."""

MODEL = "model"  # the trained model
CONSTANT_VELOCITY = "velocity stays constant"
URDF, URDF_WITH_DRIVES = "URDF", "URDF and drives"
LEAST_SQUARES = "least squares"
LEAST_SQUARES_WITH_MEMORY = "least squares with memory"
LINEAR_SERVOS, DELAYED_COMMAND = "linear servo", "delayed command"


def observed(predictor: str) -> str:
    """Return the name of the predictor with the constant disturbance that a momentum observer estimates."""
    return f"{predictor} + observer"


def is_drawn(predictor: str) -> bool:
    """True if charts show the predictor: with an observer only the model is shown."""
    return predictor == observed(MODEL) or not predictor.endswith(observed(""))
