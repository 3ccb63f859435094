"""spelgen: a URDF in, a PyTorch model of the arm's dynamics with its exact structure out."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spelgen.pipeline import build, check, inspect, load

__version__ = "0.1.0"
__all__ = ["__version__", "build", "check", "inspect", "load"]


def __getattr__(name: str) -> Any:
    """Load the pipeline on first use: `import spelgen` alone stays fast (PEP 562)."""
    if name in __all__:
        from spelgen import pipeline

        return getattr(pipeline, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
