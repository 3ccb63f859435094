"""The names of predictors, in results and wherever these are shown."""

MODEL = "model"  # the trained model
CONSTANT_VELOCITY = "velocity stays constant"
URDF, URDF_WITH_DRIVES = "URDF", "URDF and drives"
LEAST_SQUARES = "least squares"
LEAST_SQUARES_WITH_MEMORY = "least squares with memory"
POSITION_ACTUATORS = "MuJoCo actuators"
LINEAR_SERVOS, DELAYED_COMMAND = "linear servo", "delayed command"


def observed(predictor: str) -> str:
    """Return the name of the same predictor where it holds the disturbance that an observer finds."""
    return f"{predictor} + observer"


def is_drawn(predictor: str) -> bool:
    """Return whether curves show a predictor: of those with an observer they show the model alone."""
    return predictor == observed(MODEL) or not predictor.endswith(observed(""))
