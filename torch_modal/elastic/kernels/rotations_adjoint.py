"""Adjoints of kernels of rotations and poses, which Warp generates."""

import warp as wp

from torch_modal.elastic.kernels import procrustes, rotations

mean_pose = wp.kernel(procrustes.mean_pose.func, module=__name__)
right_hand_side = wp.kernel(rotations.right_hand_side.func, module=__name__)
trajectory_edges = wp.kernel(rotations.trajectory_edges.func, module=__name__)
turns = wp.kernel(rotations.turns.func, module=__name__)
