"""What other people's models minimise: elastic energies of predicted shapes, and of what a latent space decodes to."""

from torch_modal.losses.latent import LatentElasticity as LatentElasticity
from torch_modal.losses.latent import PathEnergy as PathEnergy
from torch_modal.losses.shell import ShellLoss as ShellLoss
from torch_modal.losses.shell import ShellTerms as ShellTerms
