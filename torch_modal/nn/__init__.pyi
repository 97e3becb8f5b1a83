"""The public names of this floor."""

from .adjoint import ConvergenceWarning as ConvergenceWarning
from .in_between import InBetween as InBetween
from .mid_shape import MidShape as MidShape
from .modal_energy import ModalEnergy as ModalEnergy
from .samples import ConvergenceError as ConvergenceError
from .samples import InBetweenResult as InBetweenResult
from .settings import PRESETS as PRESETS
from .settings import Objective as Objective
from .settings import Solver as Solver
from .solver import GaussNewtonStep as GaussNewtonStep
from .solver import Solution as Solution
from .solver import Status as Status
