"""What in-betweens are computed with: torch, the reference, and kernels of NVIDIA Warp, the fast path.

A backend makes each part of an in-between (:class:`torch_modal.backends.torch.backend.TorchBackend`). It is chosen
once, when a layer is made (:func:`torch_modal.backends.choice.choose`); nothing outside knows which one it is.
"""
