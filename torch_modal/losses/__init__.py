"""Losses for other models: elastic energies of predicted shapes and of decoded latents."""

from torch_modal.losses.latent import LatentElasticity as LatentElasticity
from torch_modal.losses.shell import ShellLoss as ShellLoss
from torch_modal.losses.shell import ShellTerms as ShellTerms
