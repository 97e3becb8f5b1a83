"""The file of a :class:`~torch_modal.sequence.codec.ModalSequence`: safetensors, exact or compact.

Nothing in a file is believed before it is checked.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as save_tensors
from torch import Tensor

from torch_modal.errors import MeshError
from torch_modal.io import tensors as files
from torch_modal.io.files import write_atomically
from torch_modal.sequence.codec_modes import N_SEEDS, FixedModes, fixed_modes
from torch_modal.sequence.codec_packing import PACKED, unpack

FORMAT = "torch_modal.sequence"
VERSION = "2"
PROBE_TOLERANCE = 1e-5
"""Over the diagonal: how far the modes of another machine may move what they move by 1 %."""
N_PROBES = 8

EXACT = {
    "keyframes": (torch.float64, 3),
    "faces": (torch.int64, 2),
    "keyframe_times": (torch.float64, 1),
    "times": (torch.float64, 1),
    "amplitudes": (torch.float64, 2),
    "motions": (torch.float64, 2),
    "errors": (torch.float64, 1),
    "clusters": (torch.int64, 1),
    "probe": (torch.float64, 1),
}


def write_exact(fields: Mapping[str, Any], path: Path) -> None:
    """The fields of a sequence, without loss."""
    modes = fields["modes"]
    values = {**fields, "clusters": modes.clusters, "probe": probe(modes)}
    tensors = {name: values[name].to(kind) for name, (kind, _) in EXACT.items()}
    write_atomically(path, to_bytes(tensors, {"coding": "exact", "reference": fields["reference"], "seed": modes.seed}))


def to_bytes(tensors: dict[str, Tensor], header: dict[str, Any]) -> bytes:
    """A file. The metadata is one entry: safetensors does not keep the order of several."""
    whole = {"format": FORMAT, "version": VERSION, **header}
    metadata = {"torch_modal": json.dumps(whole, sort_keys=True, separators=(",", ":"))}
    # Packed numbers have a digest of their own.
    return save_tensors(tensors, metadata) if tensors.keys() == {"packed"} else files.to_bytes(tensors, metadata)


def probe(modes: FixedModes) -> Tensor:
    """A few numbers of the modes, by which another machine knows that it has the same. *Shape:* ``(n,)``."""
    flat = modes.modes.flatten(1)
    rms = flat.square().mean(1, keepdim=True).sqrt()
    columns = torch.linspace(0, flat.shape[1] - 1, N_PROBES).long()
    rows = torch.linspace(0, len(flat) - 1, N_PROBES).long()
    return (flat / rms)[rows, columns]


def read(path: Path, cache_dir: str | None = None, cache: bool = True) -> dict[str, Any]:
    """The fields of a sequence; :meth:`torch_modal.ModalSequence.load` says more."""
    return read_bytes(path.read_bytes(), path, cache_dir, cache)


def read_bytes(data: bytes, path: Path | str, cache_dir: str | None = None, cache: bool = True) -> dict[str, Any]:
    """The same of what was read."""
    tensors, metadata = files.from_bytes(data, path, ".tms")
    header = _header(metadata, path)
    try:
        if header.get("coding") == "exact":
            parts = _checked_exact(tensors)
        elif header.get("coding") == PACKED:
            parts = unpack(tensors)
            header |= {name: parts.pop(name) for name in ("reference", "seed")}
        else:
            raise ValueError(f"its coding is {header.get('coding')!r}")
        return _assembled(parts, header, cache_dir, cache)
    except MeshError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error


def _header(metadata: dict[str, str], path: Path | str) -> dict[str, Any]:
    try:
        header = json.loads(metadata["torch_modal"])
    except (KeyError, TypeError, ValueError, RecursionError):
        raise ValueError(f"{path} holds no motion: it is another safetensors file") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"{path} holds no motion: it is another safetensors file")
    if header.get("version") != VERSION:
        raise ValueError(
            f"{path} has the version {str(header.get('version'))[:20]!r}, this program reads {VERSION!r}; a newer "
            "torch_modal may read it"
        )
    return header


def _checked_exact(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    for name, (kind, dims) in EXACT.items():
        part = tensors.get(name)
        if part is None or part.dtype != kind or part.dim() != dims:
            raise ValueError(f"its part {name!r} is missing, or not of {dims} dimensions of {kind}")
    return tensors


def _assembled(parts: dict[str, Tensor], header: dict[str, Any], cache_dir: str | None, cache: bool) -> dict[str, Any]:
    """Check that all parts fit each other, and compute the modes."""
    x, faces = parts["keyframes"], parts["faces"]
    k_times, times, a, motions = (parts[name] for name in ("keyframe_times", "times", "amplitudes", "motions"))
    clusters, seed = parts["clusters"], header.get("seed")
    reference: Any = header.get("reference")
    n, v, t = len(x), x.shape[1], len(times)
    fits = (
        isinstance(reference, int)
        and 0 <= reference < n
        and n >= 2
        and x.shape[2] == 3
        and faces.shape[1] == 3
        and len(faces) > 0
        and len(k_times) in (n, n + 1)
        and len(a) == len(motions) == len(parts["errors"]) == t >= 1
        and motions.shape[1] == 6
        and len(clusters) > 0
        and bool((clusters > 0).all())
        and int(clusters.sum()) == a.shape[1]
        and type(seed) is int
        and 0 <= seed < N_SEEDS
        and len(parts["probe"]) == N_PROBES
    )
    if not fits:
        raise ValueError("its parts do not fit each other")
    if int(faces.min()) < 0 or int(faces.max()) >= v:
        raise ValueError("it names vertices that it does not have")
    finite = all(bool(part.isfinite().all()) for part in (x, k_times, times, a, motions))
    if not finite or bool((k_times.diff() <= 0).any()) or bool((times.diff() <= 0).any()):
        raise ValueError("its numbers are not finite, or its times do not ascend")
    if len(times) and (times[0] < k_times[0] or times[-1] > k_times[-1]):
        raise ValueError("it has frames before the first or after the last key-frame")
    modes = fixed_modes(x[reference], faces, a.shape[1], clusters, seed, cache_dir, cache)
    apart = float((probe(modes) - parts["probe"]).abs().max()) * 0.01
    if not apart <= PROBE_TOLERANCE:
        raise ValueError(
            f"the modes computed here differ from those that it was written with (by {apart:.1e} of what they may); "
            "it is damaged, or was written by another version of torch_modal"
        )
    names = ("keyframes", "faces", "keyframe_times", "times", "amplitudes", "motions", "errors")
    return {**{name: parts[name] for name in names}, "modes": modes, "reference": reference}
