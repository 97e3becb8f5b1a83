"""What an in-between is computed with: torch, the reference, and kernels of NVIDIA Warp, the fast path."""
