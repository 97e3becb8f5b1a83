"""The public names, and the modules that they are loaded from when they are first used."""

from .data.augmentation import ShapeAugmentation as ShapeAugmentation
from .data.augmentation import ShapeBatch as ShapeBatch
from .data.dataset import SetBatchSampler as SetBatchSampler
from .data.dataset import ShapeDataset as ShapeDataset
from .data.deformation import RandomModalDeformation as RandomModalDeformation
from .data.packed import augment_packed as augment_packed
from .data.packed import collate_packed as collate_packed
from .data.random_in_between import RandomExtrapolation as RandomExtrapolation
from .data.random_in_between import RandomInBetween as RandomInBetween
from .data.rigid_motion import RandomRigidMotion as RandomRigidMotion
from .data.sequential import AugmentationSequential as AugmentationSequential
from .data.space import ShapeSpace as ShapeSpace
from .data.stored import StoredSet as StoredSet
from .data.stored import find_sets as find_sets
from .data.stored import open_set as open_set
from .data.stored import write_set as write_set
from .energy.shell import ShellEnergy as ShellEnergy
from .errors import MeshError as MeshError
from .errors import MeshWarning as MeshWarning
from .geometry.normals import vertex_normals as vertex_normals
from .io.write import save_animation as save_animation
from .io.write import save_frames as save_frames
from .keyframes.check import check_keyframes as check_keyframes
from .keyframes.load import load_keyframes as load_keyframes
from .keyframes.registration.landmarks import suggest_landmarks as suggest_landmarks
from .keyframes.registration.register import register as register
from .keyframes.registration.report import Registration as Registration
from .nn.between import ConvergenceError as ConvergenceError
from .nn.between import ConvergenceWarning as ConvergenceWarning
from .nn.in_between import InBetween as InBetween
from .nn.mid_shape import MidShape as MidShape
from .nn.solver import GaussNewtonStep as GaussNewtonStep
from .precompute.basis import ModalBasis as ModalBasis
from .precompute.modes import extract_bases as extract_bases
from .precompute.modes import extract_modes as extract_modes
from .sequence.subdivide import keyframe_places as keyframe_places
from .sequence.subdivide import linear_sequence as linear_sequence
from .sequence.subdivide import subdivide as subdivide
from .view.picture import render_sequence as render_sequence

__version__: str
