"""The file of a :class:`~torch_modal.codec.sequence.ModalSequence`: safetensors, exact or compact.

Everything that is read is checked before it is used.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as save_tensors
from torch import Tensor

from torch_modal.codec.compact import unpack
from torch_modal.codec.modes import N_PROBES, N_SEEDS, reproducible_modes
from torch_modal.errors import MeshError
from torch_modal.io import tensors as files
from torch_modal.io.files import write_atomically

FORMAT = "torch_modal.sequence"
VERSION = "2"
COMPACT = "packed"
PROBE_TOLERANCE = 1e-5
"""Over the diagonal: how far the modes of another machine may move what they move by 1 %."""

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
    """Write the fields of a sequence without loss."""
    modes = fields["modes"]
    values = {**fields, "clusters": modes.clusters, "probe": modes.probe()}
    tensors = {name: values[name].to(kind) for name, (kind, _) in EXACT.items()}
    metadata = _metadata({"coding": "exact", "reference": fields["reference"], "seed": modes.seed})
    write_atomically(path, files.to_bytes(tensors, metadata))


def compact_bytes(packed: bytes, times: Tensor) -> bytes:
    """A compact file; times are left out where they count the frames."""
    tensors = {"packed": torch.frombuffer(bytearray(packed), dtype=torch.uint8)}
    metadata = _metadata({"coding": COMPACT})
    if torch.equal(times, torch.arange(len(times), dtype=torch.float64)):
        return save_tensors(tensors, metadata)  # packed numbers have a digest of their own
    return files.to_bytes({**tensors, "times": times}, metadata)


def _metadata(header: dict[str, Any]) -> dict[str, str]:
    """One entry: safetensors does not keep the order of several."""
    whole = {"format": FORMAT, "version": VERSION, **header}
    return {"torch_modal": json.dumps(whole, sort_keys=True, separators=(",", ":"))}


def read(data: bytes, path: Path | str, cache_dir: str | None = None, cache: bool = True) -> dict[str, Any]:
    """The fields of a sequence from the bytes of a file; see :meth:`torch_modal.ModalSequence.load`."""
    tensors, metadata = files.from_bytes(data, path, ".tms")
    header = _header(metadata, path)
    try:
        if header.get("coding") == "exact":
            _check_exact(tensors)
            parts = {**tensors, "reference": header.get("reference"), "seed": header.get("seed")}
        elif header.get("coding") == COMPACT:
            packed = tensors.get("packed")
            if packed is None or packed.dtype != torch.uint8 or packed.dim() != 1:
                raise ValueError("one of its parts is missing")
            parts = unpack(packed.numpy().tobytes(), tensors.get("times"))
        else:
            raise ValueError(f"its coding is {header.get('coding')!r}")
        return _assembled(parts, cache_dir, cache)
    except MeshError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error


def _header(metadata: dict[str, str], path: Path | str) -> dict[str, Any]:
    try:
        header = json.loads(metadata["torch_modal"])
    except (KeyError, TypeError, ValueError, RecursionError):
        header = None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"{path} holds no motion: it is another safetensors file")
    if header.get("version") != VERSION:
        raise ValueError(
            f"{path} has the version {str(header.get('version'))[:20]!r}, this program reads {VERSION!r}; a newer "
            "torch_modal may read it"
        )
    return header


def _check_exact(tensors: dict[str, Tensor]) -> None:
    for name, (kind, dims) in EXACT.items():
        part = tensors.get(name)
        if part is None or part.dtype != kind or part.dim() != dims:
            raise ValueError(f"its part {name!r} is missing, or not of {dims} dimensions of {kind}")


def _assembled(parts: dict[str, Any], cache_dir: str | None, cache: bool) -> dict[str, Any]:
    """Check that all parts fit each other, and compute the modes."""
    keyframes, faces, clusters, probe = (parts[name] for name in ("keyframes", "faces", "clusters", "probe"))
    amplitudes, motions, errors = parts["amplitudes"], parts["motions"], parts["errors"]
    keyframe_times, times, reference, seed = (parts[name] for name in ("keyframe_times", "times", "reference", "seed"))
    n, t = len(keyframes), len(times)
    fits = (
        isinstance(reference, int)
        and 0 <= reference < n
        and n >= 2
        and keyframes.shape[2] == 3
        and faces.shape[1] == 3
        and len(faces) > 0
        and len(keyframe_times) in (n, n + 1)
        and len(amplitudes) == len(motions) == len(errors) == t >= 1
        and motions.shape[1] == 6
        and len(clusters) > 0
        and bool((clusters > 0).all())
        and int(clusters.sum()) == amplitudes.shape[1]
        and type(seed) is int
        and 0 <= seed < N_SEEDS
        and len(probe) == N_PROBES
    )
    if not fits:
        raise ValueError("its parts do not fit each other")
    if int(faces.min()) < 0 or int(faces.max()) >= keyframes.shape[1]:
        raise ValueError("it names vertices that it does not have")
    finite = all(bool(part.isfinite().all()) for part in (keyframes, keyframe_times, times, amplitudes, motions))
    if not finite or bool((keyframe_times.diff() <= 0).any()) or bool((times.diff() <= 0).any()):
        raise ValueError("its numbers are not finite, or its times do not ascend")
    if times[0] < keyframe_times[0] or times[-1] > keyframe_times[-1]:
        raise ValueError("it has frames before the first or after the last key-frame")

    modes = reproducible_modes(keyframes[reference], faces, amplitudes.shape[1], clusters, seed, cache_dir, cache)
    difference = float((modes.probe() - probe).abs().max()) * 0.01
    if not difference <= PROBE_TOLERANCE:
        raise ValueError(
            f"the modes computed here differ from those that it was written with (by {difference:.1e} of the "
            "diagonal); it is damaged, or was written by another version of torch_modal"
        )
    names = ("keyframes", "faces", "keyframe_times", "times", "amplitudes", "motions", "errors", "reference")
    return {**{name: parts[name] for name in names}, "modes": modes}
