"""Times of the key-frames of a motion."""

from collections.abc import Sequence

import torch
from torch import Tensor


def checked_times(times: Tensor | Sequence[float] | None, n_keyframes: int, cyclic: bool) -> Tensor:
    """Checked times of key-frames; if cyclic, with the end of the cycle. *Shape:* ``(K,)`` or ``(K + 1,)``.

    Raises:
        ValueError: The number of times is wrong, or they do not ascend.
    """
    n = n_keyframes + cyclic
    if times is None:
        return torch.arange(n, dtype=torch.float64)
    found = torch.as_tensor(times, dtype=torch.float64).detach().cpu()
    if found.shape != (n,):
        also = ", and one when the first comes again" if cyclic else ""
        raise ValueError(
            f"times has the shape {tuple(found.shape)}; it needs one time for each key-frame{also}: ({n},)"
        )
    if not bool(found.isfinite().all()) or bool((found.diff() <= 0).any()):
        raise ValueError(f"times must ascend from key-frame to key-frame; got {found.tolist()}")
    return found
