"""Physically plausible in-between shapes from key-frame meshes, in a space of vibration modes."""

from torch_modal.basis import ModalBasis as ModalBasis
from torch_modal.errors import MeshError as MeshError
from torch_modal.errors import MeshWarning as MeshWarning
from torch_modal.export import save_animation as save_animation
from torch_modal.export import save_frames as save_frames
from torch_modal.full_space import FullSpaceResult as FullSpaceResult
from torch_modal.full_space import full_space as full_space
from torch_modal.keyframes import check_keyframes as check_keyframes
from torch_modal.keyframes import load_keyframes as load_keyframes
from torch_modal.nn.between import ConvergenceError as ConvergenceError
from torch_modal.nn.between import ConvergenceWarning as ConvergenceWarning
from torch_modal.nn.gauss_newton import GaussNewtonStep as GaussNewtonStep
from torch_modal.nn.in_between import InBetween as InBetween
from torch_modal.nn.mid_shape import MidShape as MidShape
from torch_modal.nn.shell import ShellEnergy as ShellEnergy
from torch_modal.picture import render_sequence as render_sequence
from torch_modal.precompute.modes import extract_bases as extract_bases
from torch_modal.precompute.modes import extract_modes as extract_modes
from torch_modal.sequence import keyframe_places as keyframe_places
from torch_modal.sequence import linear_sequence as linear_sequence
from torch_modal.sequence import subdivide as subdivide
from torch_modal.version import __version__ as __version__

__all__ = [
    "ConvergenceError",
    "ConvergenceWarning",
    "FullSpaceResult",
    "GaussNewtonStep",
    "InBetween",
    "MeshError",
    "MeshWarning",
    "MidShape",
    "ModalBasis",
    "ShellEnergy",
    "__version__",
    "check_keyframes",
    "extract_bases",
    "extract_modes",
    "full_space",
    "keyframe_places",
    "linear_sequence",
    "load_keyframes",
    "render_sequence",
    "save_animation",
    "save_frames",
    "subdivide",
]
