"""spelgen: a URDF in, a PyTorch model of the arm's dynamics with its exact structure out."""

from importlib import import_module
from typing import TYPE_CHECKING

from spelgen.version import __version__ as __version__

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import Arm as Arm
    from spelgen.arm.configured_arm import load_arm as load_arm
    from spelgen.certificate.inspection import Inspection as Inspection
    from spelgen.certificate.inspection import inspect as inspect
    from spelgen.certificate.module_check import check as check
    from spelgen.design import Design as Design
    from spelgen.dynamics.friction import FrictionModel as FrictionModel
    from spelgen.dynamics.tip import tip_kinematics as tip_kinematics
    from spelgen.emission.assemble import load_module as load_module
    from spelgen.emission.build import build as build
    from spelgen.emission.specify import generate as generate
    from spelgen.errors import SpelgenError as SpelgenError
    from spelgen.evaluation.evaluate import evaluate as evaluate
    from spelgen.evaluation.results import Results as Results
    from spelgen.evaluation.rollout import rollout as rollout
    from spelgen.excitation.design import excite as excite
    from spelgen.exporting.export import export as export
    from spelgen.fitting.fit import Fit as Fit
    from spelgen.fitting.fit import RunOptions as RunOptions
    from spelgen.fitting.fit import fit as fit
    from spelgen.fitting.fit import load_run as load_run
    from spelgen.fitting.posterior import Posterior as Posterior
    from spelgen.identification.identification import Identification as Identification
    from spelgen.identification.identification import LeastSquares as LeastSquares
    from spelgen.identification.identify import identify as identify
    from spelgen.identification.intervals import Interval as Interval
    from spelgen.live.estimator import Estimator as Estimator
    from spelgen.live.estimator import EstimatorState as EstimatorState
    from spelgen.log_checks.check_logs import check_logs as check_logs
    from spelgen.logs.preprocessing import Preprocessing as Preprocessing
    from spelgen.logs.read import read_logs as read_logs
    from spelgen.logs.read import write_logs as write_logs
    from spelgen.logs.trajectory import Trajectory as Trajectory
    from spelgen.settings.fits import GaussianPrior as GaussianPrior
    from spelgen.settings.fits import MomentumFit as MomentumFit
    from spelgen.settings.fits import Rollout as Rollout
    from spelgen.settings.fits import TorqueFit as TorqueFit
    from spelgen.simulation.as_built import as_built as as_built
    from spelgen.simulation.simulate import simulate as simulate

# Module -> the names of the API that it defines. A module is imported at the first use of a name (PEP 562), so that
# `import spelgen` is fast.
_MODULES = {
    "arm.configured_arm": "load_arm Arm",
    "certificate.inspection": "inspect Inspection",
    "emission.specify": "generate",
    "design": "Design",
    "emission.build": "build",
    "emission.assemble": "load_module",
    "certificate.module_check": "check",
    "logs.read": "read_logs write_logs",
    "logs.trajectory": "Trajectory",
    "log_checks.check_logs": "check_logs",
    "logs.preprocessing": "Preprocessing",
    "simulation.simulate": "simulate",
    "simulation.as_built": "as_built",
    "excitation.design": "excite",
    "identification.identify": "identify",
    "identification.identification": "LeastSquares Identification",
    "identification.intervals": "Interval",
    "dynamics.friction": "FrictionModel",
    "fitting.fit": "fit",
    "fitting.fitted": "Fit load_run",
    "fitting.dataset": "RunOptions",
    "fitting.posterior": "Posterior",
    "settings.fits": "GaussianPrior TorqueFit MomentumFit Rollout",
    "evaluation.rollout": "rollout",
    "evaluation.evaluate": "evaluate",
    "evaluation.results": "Results",
    "dynamics.tip": "tip_kinematics",
    "exporting.export": "export",
    "live.estimator": "Estimator EstimatorState",
    "errors": "SpelgenError",
}
_HOME = {name: module for module, names in _MODULES.items() for name in names.split()}

__all__ = sorted([*_HOME, "__version__"])


def __getattr__(name: str) -> object:
    if name in _HOME:
        return vars(import_module(f"spelgen.{_HOME[name]}"))[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
