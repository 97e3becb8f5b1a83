"""How many threads a benchmark uses, so that nobody needs to set a variable of the environment first."""

import torch
from threadpoolctl import threadpool_limits


def limit_threads(n: int = 1) -> None:
    """For the rest of this process: so many threads of torch, of BLAS and of OpenMP."""
    torch.set_num_threads(n)
    threadpool_limits(n)
