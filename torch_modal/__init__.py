"""Physically plausible in-between shapes from key-frame meshes, in a space of vibration modes."""

from torch_modal.adapters import augment_packed as augment_packed
from torch_modal.adapters import collate_packed as collate_packed
from torch_modal.augment.base import ShapeAugmentation as ShapeAugmentation
from torch_modal.augment.base import ShapeBatch as ShapeBatch
from torch_modal.augment.between import RandomExtrapolation as RandomExtrapolation
from torch_modal.augment.between import RandomInBetween as RandomInBetween
from torch_modal.augment.deformation import RandomModalDeformation as RandomModalDeformation
from torch_modal.augment.normals import vertex_normals as vertex_normals
from torch_modal.augment.rigid_motion import RandomRigidMotion as RandomRigidMotion
from torch_modal.augment.sequential import AugmentationSequential as AugmentationSequential
from torch_modal.augment.space import ShapeSpace as ShapeSpace
from torch_modal.basis import ModalBasis as ModalBasis
from torch_modal.dataset import SetBatchSampler as SetBatchSampler
from torch_modal.dataset import ShapeDataset as ShapeDataset
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
from torch_modal.stored import StoredSet as StoredSet
from torch_modal.stored import find_sets as find_sets
from torch_modal.stored import open_set as open_set
from torch_modal.stored import write_set as write_set
from torch_modal.version import __version__ as __version__

__all__ = [
    "AugmentationSequential",
    "ConvergenceError",
    "ConvergenceWarning",
    "FullSpaceResult",
    "GaussNewtonStep",
    "InBetween",
    "MeshError",
    "MeshWarning",
    "MidShape",
    "ModalBasis",
    "RandomExtrapolation",
    "RandomInBetween",
    "RandomModalDeformation",
    "RandomRigidMotion",
    "SetBatchSampler",
    "ShapeAugmentation",
    "ShapeBatch",
    "ShapeDataset",
    "ShapeSpace",
    "ShellEnergy",
    "StoredSet",
    "__version__",
    "augment_packed",
    "check_keyframes",
    "collate_packed",
    "extract_bases",
    "extract_modes",
    "find_sets",
    "full_space",
    "keyframe_places",
    "linear_sequence",
    "load_keyframes",
    "open_set",
    "render_sequence",
    "save_animation",
    "save_frames",
    "subdivide",
    "vertex_normals",
    "write_set",
]
