"""Helpers for autograd functions, cached tensors, broadcasting and threads, with less overhead than in torch.

Torch's private names are used here alone, and only where no public one exists:

- ``torch._C._functorch.peek_interpreter_stack`` and ``forward_ad._current_level`` tell that a transform of
  ``torch.func`` or forward mode is active (:func:`within_transforms`);
- ``_get_current_dispatch_mode`` tells the same of dispatch modes, which other threads would not have;
- ``torch._C._functorch.is_batchedtensor`` tells ``vmap`` from other transforms;
- ``_disable_current_modes`` and ``torch._C.DisableTorchFunction`` compute numbers during ``torch.export``, which would
  otherwise record the computation;
- ``torch._functorch.eager_transforms.JVP_NESTING`` tells forward mode within forward mode;
- ``torch._C._autograd._top_saved_tensors_default_hooks`` and its like set hooks on saved tensors aside, as those of
  checkpoints, which ``torch.func`` refuses.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from functools import partial, wraps
from typing import Any, ParamSpec, Protocol, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils._python_dispatch import _disable_current_modes, _get_current_dispatch_mode

from torch_modal import trees

Made = TypeVar("Made")
Given = ParamSpec("Given")
Linear = Callable[[Tensor], Tensor]
Tensors = TypeVar("Tensors", Tensor, tuple[Tensor, ...])
InDims = tuple[int | None, ...]
"""Dimension of each argument that ``vmap`` maps, None for one that it does not map."""
Vmapped = tuple[tuple[Tensor, ...], tuple[int, ...]]
"""Results under ``vmap`` and their mapped dimensions."""
Context = Any
"""What an autograd function keeps from its forward to its backward pass: an object that takes any attribute."""


class VmapInfo(Protocol):
    """First argument of the rule that an autograd function has for ``vmap``."""

    batch_size: int
    """Size of the dimension that is mapped."""


#: The dispatch mode of this thread, or None.
current_dispatch_mode: Callable[[], object] = _get_current_dispatch_mode


def is_traced(x: Tensor) -> bool:
    """True for a tensor without data (torch.compile, export, fake and meta tensors), so that no kernel can use it."""
    return torch.compiler.is_compiling() or has_no_data(x)


def has_no_data(x: Tensor) -> bool:
    """True for a fake or meta tensor."""
    return type(x) not in (Tensor, torch.nn.Parameter) or x.is_meta


def within_transforms() -> bool:
    """True while a transform of ``torch.func`` or forward-mode differentiation is active in this thread."""
    return torch._C._functorch.peek_interpreter_stack() is not None or forward_ad._current_level >= 0


def is_transformed(x: Tensor) -> bool:
    """True for a wrapper of a ``torch.func`` transform, or a tensor with a tangent of forward-mode differentiation."""
    if torch.func.debug_unwrap(x, recurse=False) is not x:
        return True
    return forward_ad._current_level >= 0 and forward_ad.unpack_dual(x).tangent is not None  # the first alone is fast


def is_eager(*tensors: Tensor) -> bool:
    """True for tensors that all have numbers, which are all that there is to them: neither traced nor transformed."""
    if torch.compiler.is_compiling():
        return False
    within = within_transforms()
    return not any(has_no_data(x) or (within and is_transformed(x)) for x in tensors)


def is_vmapped(x: Tensor) -> bool:
    """True where ``vmap`` maps a tensor, so that no number of it is one number."""
    inner = torch.func.debug_unwrap(x, recurse=False)
    return inner is not x and (torch._C._functorch.is_batchedtensor(x) or is_vmapped(inner))


def require_numbers(layer: str, x: Tensor) -> None:
    """Raise where tensors have no numbers, which decide the steps of a layer.

    Raises:
        RuntimeError: The tensor is on the meta device, or ``torch.export`` is at work.
    """
    if not x.is_meta and not torch.compiler.is_exporting():
        return
    kind = "a meta tensor has" if x.is_meta else "torch.export has"
    raise RuntimeError(
        f"{layer} takes steps that depend on the numbers of its input, and {kind} none: move it to a device with data, "
        "and leave it out of what is exported; docs/solving.md names the settings and layers that can be exported"
    )


def is_double_backward(*tensors: Tensor) -> bool:
    """True where a backward pass is itself differentiated, which kernels cannot be."""
    return torch.is_grad_enabled() or any(map(is_transformed, tensors))


def outside_inference_mode(make: Callable[Given, Made]) -> Callable[Given, Made]:
    """Decorate a function whose results are cached: no gradient is recorded, and no result is an inference tensor.

    Autograd rejects inference tensors, so cached tensors must not be created in ``torch.inference_mode()``.
    """

    @wraps(make)
    def run(*args: "Given.args", **kwargs: "Given.kwargs") -> Made:  # Dynamo would guard typing objects
        if not torch.is_inference_mode_enabled():
            with torch.no_grad():
                return make(*args, **kwargs)
        with torch.inference_mode(False), torch.no_grad():  # in this order: the first turns gradients on
            return make(*args, **kwargs)

    return run


def full_precision(compute: Callable[Given, Made]) -> Callable[Given, Made]:
    """Decorate a function of tensors: no autocast, and no TF32 or bfloat16 inside products of float32.

    Factorisations would fail, and shapes be wrong by thousandths.
    """

    @wraps(compute)
    def run(*args: "Given.args", **kwargs: "Given.kwargs") -> Made:
        tensors = trees.leaves((*args, *kwargs.values()))
        device = tensors[0].device.type if tensors and not tensors[0].is_meta else "cpu"  # "meta" has no autocast
        if torch.is_autocast_enabled(device):  # no region else: exported programs cannot be saved with one
            with torch.autocast(device, enabled=False):
                return run(*args, **kwargs)
        precision = torch.get_float32_matmul_precision()
        if precision == "highest":
            return compute(*args, **kwargs)
        torch.set_float32_matmul_precision("highest")
        try:
            return compute(*args, **kwargs)
        finally:
            torch.set_float32_matmul_precision(precision)

    return run


def disable_compile(compute: Callable[Given, Made]) -> Callable[Given, Made]:
    """Decorate a function that ``torch.compile`` calls as it is: to trace its data-dependent steps takes minutes."""

    @wraps(compute)
    def run(*args: "Given.args", **kwargs: "Given.kwargs") -> Made:
        if torch.compiler.is_dynamo_compiling() and not torch.compiler.is_exporting():  # it imports Dynamo: only here
            return torch.compiler.disable(compute)(*args, **kwargs)  # type: ignore[no-any-return]
        return compute(*args, **kwargs)

    code = run.__code__.replace(co_name=compute.__name__)  # type: ignore[attr-defined]
    run.__code__ = code  # type: ignore[attr-defined]  # Dynamo limits how often one code is compiled
    return run


def without_saved_tensor_hooks(compute: Callable[Given, Made]) -> Callable[Given, Made]:
    """Decorate a function that differentiates by ``torch.func``: hooks on saved tensors are set aside meanwhile."""

    @wraps(compute)
    def run(*args: "Given.args", **kwargs: "Given.kwargs") -> Made:
        hooks = torch._C._autograd._top_saved_tensors_default_hooks(True)
        if hooks is None:
            return compute(*args, **kwargs)
        torch._C._autograd._pop_saved_tensors_default_hooks()
        try:
            return run(*args, **kwargs)
        finally:
            torch._C._autograd._push_saved_tensors_default_hooks(*hooks)

    return run


class Recent:
    """The most recently used objects, up to a limit.

    ``cachetools.LRUCache`` makes room after the new object is made; this before, so that large objects never exceed the
    limit.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._kept: OrderedDict[Hashable, object] = OrderedDict()

    def __reduce__(self) -> tuple[type["Recent"], tuple[int]]:
        return Recent, (self.limit,)  # copies and pickles are empty

    def get(self, key: Hashable, make: Callable[[], Made]) -> Made:
        """The object of a key; computed if it is not in the cache, by :func:`run_outside_transforms`."""
        if key not in self._kept:
            while len(self._kept) >= self.limit:  # before making, so that there are never more
                self._kept.popitem(last=False)
            self._kept[key] = run_outside_transforms(make)
        self._kept.move_to_end(key)
        return self._kept[key]  # type: ignore[return-value]


def as_normal_tensor(x: Tensor) -> Tensor:
    """The tensor, or a copy if it is an inference tensor; within :func:`outside_inference_mode`."""
    return x.clone() if x.is_inference() else x


@disable_compile
def run_outside_transforms(make: Callable[..., Made], *seen: Tensor) -> Made:
    """Create an object outside of all transforms of ``torch.func``, to cache it or of numbers.

    Args:
        make: The function.
        seen: Its arguments, whose numbers it can read; what ``vmap`` maps is their first dimension.
    """
    if torch.compiler.is_exporting():  # without the modes that would record it
        with _disable_current_modes(), torch._C.DisableTorchFunction():
            return outside_inference_mode(make)(*seen)
    if not within_transforms():
        return outside_inference_mode(make)(*seen)
    made: list[Made] = []
    _Outside.apply(lambda *arguments: made.append(make(*arguments)), torch.empty(0), *seen)
    return made[0]


class _Outside(torch.autograd.Function):
    """``forward`` runs below all transforms, so its tensors outlive them."""

    @staticmethod
    def forward(work: Callable[..., None], nothing: Tensor, *seen: Tensor) -> Tensor:
        outside_inference_mode(work)(*seen)
        return nothing.clone()

    @staticmethod
    def setup_context(ctx: Context, inputs: tuple[object, ...], output: Tensor) -> None:
        """Saves nothing."""

    @staticmethod
    def jvp(ctx: Context, *tangents: Tensor | None) -> Tensor:
        return torch.empty(0)

    @staticmethod
    def backward(ctx: Context, *grads: Tensor) -> tuple[None, ...]:
        return (None,) * len(ctx.needs_input_grad)

    @staticmethod
    def vmap(
        info: VmapInfo, in_dims: InDims, work: Callable[..., None], nothing: Tensor, *seen: Tensor
    ) -> tuple[Tensor, int | None]:
        first = [x if dim is None else x.movedim(dim, 0) for x, dim in zip(seen, in_dims[2:], strict=True)]
        return _Outside.apply(work, nothing, *first), in_dims[1]


def apply_function(function: type[torch.autograd.Function], *arguments: object) -> Any:
    """``function.apply`` of a :class:`torch.autograd.Function` with ``setup_context``.

    Without a gradient to record it calls ``forward`` directly: torch inspects the signature at every call, which takes
    as long as a small kernel.
    """
    if needs_function(*(value for value in arguments if isinstance(value, Tensor))):
        return function.apply(*arguments)
    with torch.no_grad():
        return function.forward(*arguments)


def needs_function(*tensors: Tensor) -> bool:
    """True where autograd or a transform has to see an operation on tensors."""
    return (torch.is_grad_enabled() and any(x.requires_grad for x in tensors)) or not is_eager(*tensors)


class _LinearMap(torch.autograd.Function):
    @staticmethod
    def forward(apply: Linear, transpose: Linear, x: Tensor) -> Tensor:
        return apply(x.detach())

    @staticmethod
    def setup_context(ctx: Context, inputs: tuple[object, ...], output: Tensor) -> None:
        ctx.forwards, ctx.backwards, _ = inputs

    @staticmethod
    def jvp(ctx: Context, _: None, __: None, tangent: Tensor) -> Tensor:
        return linear_map(ctx.forwards, ctx.backwards, tangent)

    @staticmethod
    def backward(ctx: Context, *grads: Tensor) -> tuple[None, None, Tensor]:
        return None, None, linear_map(ctx.backwards, ctx.forwards, grads[0])

    @staticmethod
    def vmap(
        info: VmapInfo, in_dims: tuple[None, None, int], apply: Linear, transpose: Linear, x: Tensor
    ) -> tuple[Tensor, int]:
        return linear_map(apply, transpose, x.movedim(in_dims[2], 0)), 0


#: A linear map of a tensor, with all derivatives and transforms, from a map and its transpose without any. Both take
#: further dimensions in front, which ``vmap`` adds.
linear_map: Callable[[Linear, Linear, Tensor], Tensor] = partial(apply_function, _LinearMap)


def apply_transpose(
    linear: Callable[..., Sequence[Tensor]], zeros: Tensors, inputs: Sequence[Tensor], tangents: Sequence[Tensor | None]
) -> Tensors:
    """The transpose of a linear function, times tangents of what it gives, None for zero.

    Of the gradient of a function, it is the Jacobian of the function times the tangents. Within
    ``torch.autograd.forward_ad``, torch has no other forward mode, but reverse mode.

    Args:
        linear: The function.
        zeros: What it takes.
        inputs: What it gives has these shapes.
        tangents: One of each.

    Raises:
        RuntimeError: This is forward mode within forward mode.
    """
    if torch._functorch.eager_transforms.JVP_NESTING > 1:  # type: ignore[attr-defined]
        raise RuntimeError(
            "forward mode within forward mode: torch would leave out a part of the second derivative here; take jvp or "
            "jacfwd of grad, vjp or jacrev"
        )
    known = (torch.zeros_like(x) if tangent is None else tangent for x, tangent in zip(inputs, tangents, strict=True))
    return torch.func.vjp(lambda to: tuple(linear(to)), zeros)[1](tuple(known))[0]


def apply_merged(
    function: type[torch.autograd.Function],
    fixed: tuple[object, ...],
    info: VmapInfo,
    in_dims: InDims,
    tensors: Sequence[Tensor],
) -> Vmapped:
    """Rule for ``vmap`` of a function of samples: the mapped dimension of all tensors is merged with the first.

    Args:
        function: Its arguments are the fixed ones, then the tensors.
        fixed: Arguments that are not mapped.
        info: As ``vmap`` gives it.
        in_dims: Mapped dimensions of all arguments.
        tensors: *Shape of each:* ``(B, ...)`` and the mapped dimension.
    """
    n, flat = info.batch_size, []
    for tensor, dim in zip(tensors, in_dims[len(fixed) :], strict=True):
        batched = tensor.expand(n, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        flat.append(batched.flatten(0, 1).contiguous())  # as kernels want them
    results = function.apply(*fixed, *flat)
    return tuple(x.unflatten(0, (n, -1)) for x in results), (0,) * len(results)
