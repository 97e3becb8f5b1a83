"""What layers keep between calls: made in inference mode, of a state that is loaded, of tensors edited in place."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from conftest import Shapes
from torch import Tensor, nn

import torch_modal as tm

DOUBLE = torch.float64
TIMES = torch.tensor([0.0, 1.0, 3.0], dtype=DOUBLE)
AMPLITUDES = torch.tensor([[1.0, -2.0, 3.0], [0.5, 0.0, -1.0]], dtype=DOUBLE)

Case = tuple[Callable[[Shapes], Any], Callable[[Any, Tensor], Tensor]]


def decoder_of(shapes: Shapes, i: int = 0) -> tm.ModalDecoder:
    basis = shapes.bases[i]
    return tm.ModalDecoder(shapes.keyframes, shapes.faces, TIMES, basis.reference, basis.modes)


def transform(kind: type[tm.ShapeAugmentation], pool: bool) -> Case:
    def make(shapes: Shapes) -> Any:
        return tm.ShapeSpace(shapes.bases, shapes.faces), kind(p=1.0)

    def call(made: Any, x: Tensor) -> Tensor:
        space, own = made
        others = tm.ShapeBatch.of_keyframes(space, x) if pool else None
        return own(x, space=space, pool=others)

    return make, call


def stiff(shapes: Shapes) -> tm.InBetween:
    objective = tm.Objective(alpha=torch.tensor(400.0), mu=torch.tensor(2.0), terms=(Edges(torch.tensor(3.0)),))
    return tm.InBetween(shapes.bases[:2], shapes.faces, objective=objective)


class Edges(tm.Term):
    """Lengths of edges."""

    def elements(self, mesh: Any) -> Tensor:
        return mesh.edges

    def measure(self, edge_vectors: Tensor) -> Tensor:
        return edge_vectors[0].norm()


CASES: dict[str, Case] = {
    "accurate": (lambda s: tm.InBetween(s.bases[:2], s.faces), lambda made, x: made(x[0], x[1], 0.5)),
    "fast": (lambda s: tm.InBetween(s.bases[:2], s.faces, "fast"), lambda made, x: made(x[0], x[1], 0.5)),
    "torch": (
        lambda s: tm.InBetween(s.bases[:2], s.faces, solver=tm.Solver(backend="torch")),
        lambda made, x: made(x[0], x[1], 0.5),
    ),
    "own terms": (stiff, lambda made, x: made(x[0], x[1], 0.5)),
    "mid-shape": (lambda s: tm.MidShape(s.bases[:2], s.faces), lambda made, x: made(x[0], x[1])),
    "path": (lambda s: tm.Path(s.bases, s.faces), lambda made, x: made(x, torch.tensor([0.5, 1.5]))),
    "pairs of a path": (
        lambda s: tm.Path(s.bases, s.faces, smooth=False),
        lambda made, x: made(x, torch.tensor([0.5, 1.5])),
    ),
    "decoder": (decoder_of, lambda made, x: made(AMPLITUDES * x.mean(), torch.tensor([0.5, 2.5]))),
    "decoder of key-frames": (decoder_of, lambda made, x: made(AMPLITUDES, torch.tensor([0.5, 2.5]), keyframes=x)),
    "energy": (lambda s: tm.ShellEnergy(s.faces, terms=(Edges(torch.tensor(3.0)),)), lambda made, x: made(x[0], x[1])),
    **{
        f"{kind.__name__}, {'a pool' if pool else 'the batch'}": transform(kind, pool)
        for kind in (tm.RandomInBetween, tm.RandomExtrapolation, tm.RandomModalDeformation, tm.RandomRigidMotion)
        for pool in (False, True)
    },
}


def tensors_of(value: Any, seen: set[int]) -> Iterator[Tensor]:
    """All tensors that an object of the package keeps, wherever they are, but for the settings of its caller."""
    if id(value) in seen or isinstance(value, tm.Objective):
        return
    seen.add(id(value))
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, dict):
        for part in list(value.values()):
            yield from tensors_of(part, seen)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from tensors_of(part, seen)
    elif type(value).__module__.startswith(("torch_modal", "test_")) and hasattr(value, "__dict__"):
        yield from tensors_of(vars(value), seen)


def gradient(call: Callable[[Any, Tensor], Tensor], made: Any, x: Tensor) -> Tensor:
    x = x.clone().requires_grad_()
    torch.manual_seed(0)
    call(made, x).square().sum().backward()
    assert x.grad is not None
    return x.grad


class TestInferenceMode:
    """What is made there serves a training: autograd refuses inference tensors for good."""

    @pytest.mark.parametrize("made_there", [False, True], ids=["first used", "made"])
    @pytest.mark.parametrize("name", CASES)
    def test_gradients_afterwards(self, name: str, made_there: bool, small_bars: Shapes) -> None:
        make, call = CASES[name]
        truth = gradient(call, make(small_bars), small_bars.keyframes)
        assert float(truth.abs().max()) > 0
        with torch.inference_mode(made_there):
            made = make(small_bars)
        with torch.inference_mode():
            call(made, small_bars.keyframes)
        kept = list(tensors_of(made, set()))
        assert kept
        assert not any(tensor.is_inference() for tensor in kept)
        torch.testing.assert_close(gradient(call, made, small_bars.keyframes), truth)

    def test_moved_there(self, small_bars: Shapes) -> None:
        for name in ("accurate", "decoder of key-frames"):
            make, call = CASES[name]
            made = make(small_bars)
            with torch.inference_mode():
                made.to(torch.float32).to(DOUBLE)
            truth = gradient(call, make(small_bars), small_bars.keyframes)
            found = gradient(call, made, small_bars.keyframes)
            torch.testing.assert_close(found, truth, rtol=0, atol=1e-4 * float(truth.abs().max()))

    def test_bases_and_parameters_of_it(self, small_bars: Shapes) -> None:
        """Bases and draws that are made in inference mode are plain tensors, too."""
        motion = tm.RandomRigidMotion(p=1.0)
        with torch.inference_mode():
            own = small_bars.bases[0]
            basis = tm.ModalBasis(own.reference.clone(), own.eigenvalues * 1, own.modes * 1, own.rigid_eigenvalues * 1)
            motion(small_bars.keyframes)
        assert not any(getattr(basis, name).is_inference() for name in ("reference", "modes", "eigenvalues"))
        x = small_bars.keyframes.clone().requires_grad_()
        motion(x, motion.params).square().sum().backward()


class TestDecoder:
    """A decoder is a function of its state, whatever it was used for before."""

    @staticmethod
    def values(decoder: tm.ModalDecoder) -> Tensor:
        return decoder(AMPLITUDES[:, None], torch.tensor([0.3, 1.0, 2.2], dtype=DOUBLE))

    @pytest.fixture
    def others(self, small_bars: Shapes) -> Shapes:
        """Other shapes of the same faces, in another order and size."""
        bases = [
            tm.ModalBasis(2.0 * basis.reference, basis.eigenvalues, basis.modes.flip(0), basis.rigid_eigenvalues)
            for basis in small_bars.bases[::-1]
        ]
        return Shapes(2.0 * small_bars.keyframes.flip(0), small_bars.faces, bases)

    @pytest.mark.parametrize("assign", [False, True])
    def test_a_loaded_state(self, small_bars: Shapes, others: Shapes, assign: bool) -> None:
        decoder, other = decoder_of(small_bars), decoder_of(others, 1)
        before, wanted = self.values(decoder), self.values(other)
        assert float((before - wanted).abs().max()) > 1
        decoder.load_state_dict(copy.deepcopy(other.state_dict()), assign=assign)
        torch.testing.assert_close(self.values(decoder), wanted, rtol=0, atol=1e-12)
        assert torch.equal(decoder.size, other.size)

    def test_loose_pieces_come_along_with_a_loaded_state(self, small_bars: Shapes, others: Shapes) -> None:
        n = small_bars.keyframes.shape[1]

        def two(shapes: Shapes, factor: float) -> Shapes:
            faces = torch.cat([small_bars.faces, small_bars.faces + n])
            bases = [
                tm.ModalBasis(
                    torch.cat([basis.reference, basis.reference + 9]),
                    basis.eigenvalues,
                    torch.cat([basis.modes, factor * basis.modes + factor], 1),
                    basis.rigid_eigenvalues,
                )
                for basis in shapes.bases
            ]
            return Shapes(torch.cat([shapes.keyframes, shapes.keyframes + 9], 1), faces, bases)

        decoder, other = decoder_of(two(small_bars, 1.0)), decoder_of(two(others, -2.0), 1)
        self.values(decoder)
        decoder.load_state_dict(other.state_dict())
        torch.testing.assert_close(self.values(decoder), self.values(other), rtol=0, atol=1e-12)

    def test_edited_in_place(self, small_bars: Shapes) -> None:
        decoder = decoder_of(small_bars)
        before = self.values(decoder)
        for edit in (
            lambda: decoder.keyframes[1].mul_(1.2),
            lambda: decoder.keyframes.data[2].add_(0.1),  # which counts no version
            lambda: decoder.times[1].add_(0.5),
        ):
            edit()
            shapes = Shapes(decoder.keyframes.clone(), small_bars.faces, small_bars.bases)
            basis = shapes.bases[0]
            fresh = tm.ModalDecoder(shapes.keyframes, shapes.faces, decoder.times, basis.reference, basis.modes)
            wanted, found = self.values(fresh), self.values(decoder)
            assert float((wanted - before).abs().max()) > 1e-2
            torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)
            torch.testing.assert_close(decoder.interval(1).pair.first, fresh.interval(1).pair.first)
            before = found

    def test_functional_call(self, small_bars: Shapes) -> None:
        decoder = decoder_of(small_bars)
        before = self.values(decoder)
        moved = 1.5 * small_bars.keyframes
        wanted = self.values(decoder_of(Shapes(moved, small_bars.faces, small_bars.bases)))
        given = AMPLITUDES[:, None], torch.tensor([0.3, 1.0, 2.2], dtype=DOUBLE)
        found = torch.func.functional_call(decoder, {"keyframes": moved}, given)
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)
        torch.testing.assert_close(self.values(decoder), before, rtol=0, atol=0)

    def test_what_did_not_change_is_not_made_again(self, small_bars: Shapes) -> None:
        decoder = decoder_of(small_bars)
        self.values(decoder)
        kept = decoder.interval(0), decoder.blend(0)
        self.values(decoder)
        assert (decoder.interval(0), decoder.blend(0)) == kept
        assert isinstance(decoder, nn.Module)
