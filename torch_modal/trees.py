"""Nested tuples and lists of tensors of one batch."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

Tree = TypeVar("Tree")

HERE = "here"
"""Stands in a skeleton where a tensor was."""


def leaves(tree: object) -> list[Tensor]:
    """The tensors, in order."""
    if isinstance(tree, Tensor):
        return [tree]
    return [tensor for branch in tree for tensor in leaves(branch)] if isinstance(tree, (tuple, list)) else []


def map_leaves(tree: Any, function: Callable[[Any], Any]) -> Any:
    """Apply a function to each tensor of a tree; other leaves stay."""
    if isinstance(tree, (Tensor, str)):
        return function(tree)
    if isinstance(tree, (tuple, list)):
        parts = [map_leaves(branch, function) for branch in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)
    return tree


def skeleton(tree: object) -> object:
    """The tree with :data:`HERE` in the places of its tensors."""
    return map_leaves(tree, lambda _: HERE)


def fill(tree: object, tensors: Iterable[Tensor]) -> Any:
    """Replace the tensors of a tree or skeleton, in order."""
    each = iter(tensors)
    return map_leaves(tree, lambda _: next(each))


def rows(tree: Tree, samples: Tensor | slice) -> Tree:
    """Pick some of the samples."""
    return map_leaves(tree, lambda tensor: tensor[samples])


def join(trees: Sequence[Any]) -> Any:
    """Join the samples of trees of one structure."""
    return fill(trees[0], map(torch.cat, zip(*map(leaves, trees), strict=True)))
