"""Types of the values in a settings file, and the base class of its groups of keys."""

from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

# Largest magnitude of a number in settings. With this bound, products of several numbers do not overflow.
MAX_MAGNITUDE = 1e12


def no_bool(value: object) -> object:
    """Return the value of a number in settings, unchanged. Raises ValueError if it is a bool."""
    # YAML reads `yes` as True, and float(True) is 1.0: without this check `yes` would be accepted as a number.
    if isinstance(value, bool):
        raise ValueError("a number")
    return value


def bounded(value: float) -> float:
    """Return a number in settings, unchanged. Raises ValueError if its magnitude exceeds MAX_MAGNITUDE."""
    if abs(value) > MAX_MAGNITUDE:
        raise ValueError(f"a number within +-{MAX_MAGNITUDE:g}")
    return value


Number = Annotated[float, BeforeValidator(no_bool), Field(allow_inf_nan=False), AfterValidator(bounded)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, lt=1)]
Whole = Annotated[int, BeforeValidator(no_bool), Field(ge=0)]
Count = Annotated[int, BeforeValidator(no_bool), Field(ge=1)]
Inputs = Annotated[tuple[Number, ...], Field(min_length=1)]


class Group(BaseModel):
    """Base class of a group of keys in a settings file; an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)
