"""Devices without having them: tensors without numbers that claim to be on a GPU.

``FakeTensorMode`` runs every operation on shapes, dtypes and devices alone, and refuses those that mix devices. What
looks at numbers cannot run so: loops that end by a tolerance, line searches, the placement of key-frames, kernels, and
the searches for contacts, which run on the CPU; nor autograd, which asks the device for its streams. The largest pieces
between these are called here, one after the other.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch
from conftest import Shapes
from torch import Tensor, nn
from torch._subclasses import FakeTensor, FakeTensorMode
from torch.overrides import TorchFunctionMode

import torch_modal as tm
from torch_modal import trees
from torch_modal.contact.active import ContactEnergy, Contacts
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.steps import SumOfEnergies, TermsTowards
from torch_modal.inbetween.alignment import Pose
from torch_modal.inbetween.paired import PairedSpace
from torch_modal.inbetween.settings import PRESETS

DOUBLE = torch.float64
ELEMENTS = torch.tensor([[0, 1, 2, 9], [3, 4, 5, 8]])


class OnGpu(TorchFunctionMode):
    """Four things that torch without CUDA refuses with such tensors, done by operations that it has."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func is torch.Tensor.__getitem__ and args[0].device.type == "cuda":
            return picked(*args)
        if func is torch.Tensor.contiguous and args[0].device.type == "cuda":
            return torch.ops.aten.clone(args[0], memory_format=torch.contiguous_format)
        if func is torch.Tensor.to or (func is torch.as_tensor and isinstance(args[0], Tensor)):
            names = dict(kwargs)
            if func is torch.as_tensor:
                names |= dict(zip(("dtype", "device"), args[1:], strict=False))
                names = {name: value for name, value in names.items() if value is not None}
                args = args[:1]
            device, dtype = torch._C._nn._parse_to(*args[1:], **names)[:2]
            if device is not None and device.type == "cuda":
                return torch.ops.aten._to_copy(args[0], dtype=dtype, device=device)
        return func(*args, **kwargs)


def picked(x: Tensor, which: Any) -> Tensor:
    """``x[which]`` by other operations."""
    which = list(which) if isinstance(which, tuple) else [which]
    if any(one is Ellipsis for one in which):
        i = next(i for i, one in enumerate(which) if one is Ellipsis)
        which[i : i + 1] = [slice(None)] * (x.dim() + 1 + which.count(None) - len(which))
    dim, places = 0, []
    for one in which:
        if one is None:
            x = x.unsqueeze(dim)
        elif isinstance(one, slice):
            x = torch.ops.aten.slice(x, dim, one.start, one.stop, one.step or 1)
        elif isinstance(one, int):
            x = x.select(dim, one)
            continue
        else:
            own = one if isinstance(one, Tensor) else torch.tensor(one, device="cuda")
            places += [None] * (dim - len(places)) + [own]
        dim += 1
    return torch.ops.aten.index(x, places) if places else x


@contextmanager
def gpu() -> Iterator[FakeTensorMode]:
    """A GPU that nobody needs to have. Modules are made before, with numbers."""
    with FakeTensorMode(allow_non_fake_inputs=True) as mode, OnGpu():
        yield mode


def there(x: Tensor, mode: FakeTensorMode) -> Tensor:
    """A tensor of the same shape, there."""
    return FakeTensor(mode, x.to("meta"), torch.device("cuda:0"))


def on_gpu(module: nn.Module, mode: FakeTensorMode) -> None:
    """Move the buffers of a module there."""
    for part in module.modules():
        for name, buffer in part._buffers.items():
            if buffer is not None:
                part._buffers[name] = there(buffer, mode)


def blank(*shape: int, dtype: torch.dtype = DOUBLE) -> Tensor:
    """Numbers of no value, there."""
    return torch.empty(*shape, dtype=dtype, device="cuda")


def assert_there(tree: Any) -> None:
    """All tensors of a result are on the GPU."""
    if isinstance(tree, Tensor):
        assert tree.device.type == "cuda"
    elif isinstance(tree, (tuple, list)):
        for part in tree:
            assert_there(part)


def steps(energy: Energy, x: Tensor, reference: Any) -> None:
    """All that a step of all vertices does but for its length."""
    problem = SumOfEnergies([TermsTowards(energy, reference)])
    at = problem.at(x)
    assert_there([problem.value(x), at.value, at.gradient, problem.newton_direction(at, 3)])


def assert_core_runs(core: Any, x: Tensor, stiffness: list[Tensor]) -> None:
    """An in-between but for its base and its loops: one step, the way back."""
    rests = RestShapes(torch.stack([x, x + 1], 1), blank(2, 2), stiffness)
    pose, shapes = Pose(blank(2, 3, 3), blank(2, 3)), x
    if core.space is not None:
        placement, a = core.space.place(x, rests, blank(2)), blank(2, core.space.n_amplitudes)
        paired = isinstance(core.space, PairedSpace)
        shapes = core.space.lift(a, rests.shapes)[0] if paired else core.space.lift(a, x)
        assert_there([placement, core.space.value(a, placement), shapes])
    assert_there([core.alignment.to_caller(shapes, pose), core.alignment.to_frame(shapes, pose)])
    reference = rests.reference(core.fine.energy)
    assert_there(reference)
    steps(core.fine.energy, shapes, reference)


def test_shell_energy(small_bars: Shapes) -> None:
    shell = tm.ShellEnergy(small_bars.faces)
    with gpu() as mode, torch.no_grad():
        on_gpu(shell, mode)
        assert_there(shell(blank(2, 30, 3), blank(2, 30, 3)))


@pytest.mark.parametrize("backend", ["torch", "warp"])
@pytest.mark.parametrize("preset", ["accurate", "modal", "paper"])
@pytest.mark.parametrize("kind", ["InBetween", "InBetween with contact", "MidShape"])
def test_layers_stay_on_the_gpu(small_bars: Shapes, kind: str, preset: Any, backend: Any) -> None:
    if backend == "warp":
        pytest.importorskip("warp")
    if preset == "paper" and "contact" in kind:
        pytest.skip("the paired space has none")
    solver = replace(PRESETS[preset].solver, backend=backend)
    bases, faces = small_bars.bases[:2], small_bars.faces
    if kind == "MidShape":
        layer: Any = tm.MidShape(bases, faces, preset=preset, solver=solver).in_between
    else:
        if "contact" in kind:
            pytest.importorskip("igl")
        layer = tm.InBetween(bases, faces, preset, solver=solver, contact="contact" in kind or None)
    with gpu() as mode, torch.no_grad():
        on_gpu(layer, mode)
        t = blank(2)
        assert_core_runs(layer.core, blank(2, 30, 3), layer.stiffness_of(t, t.shape))


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_splines_stay_on_the_gpu(small_bars: Shapes, backend: str) -> None:
    """Triangles and poses between key-frames."""
    spline = tm.Path(small_bars.keyframes, small_bars.faces, solver=tm.Solver(backend=backend)).splines[0]
    knots = spline.knots(small_bars.keyframes[None])
    with gpu() as mode, torch.no_grad():
        on_gpu(spline, mode)
        knots = trees.fill(knots, [there(x, mode) for x in trees.leaves(knots)])
        u, which = blank(2), torch.zeros(2, dtype=torch.int64, device="cuda")
        assert_there([spline.straight(knots, 1, which, u), spline.pose(knots, 1, which, u)])
        assert_there(spline.rotations[1].edges_along(spline.trajectory(knots, 1), which, u))


def test_contact_energies_stay_on_the_gpu() -> None:
    with gpu() as mode, torch.no_grad():
        x, contacts = blank(2, 30, 3), Contacts(torch.arange(2, device="cuda"), there(ELEMENTS, mode))
        energy = ContactEnergy(contacts, blank(30), x)
        assert_there([energy.shortfall(x), energy.value(x)])
