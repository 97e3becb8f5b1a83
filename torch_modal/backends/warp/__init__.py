"""The fast path: kernels of NVIDIA Warp."""
