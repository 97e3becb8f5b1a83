"""Integers as bits: the range coder of the library constriction, with a distribution for each kind of number.

An integer is split into an upper part, which is entropy-coded, and ``shift`` low bits, which are stored as they are.
The distribution of the upper part has two parameters: the odds of zero, and the ratio of the probabilities of
successive magnitudes. Magnitudes beyond the table follow as an escape code. Shift and parameters are fitted to the
numbers of each kind and stored before them. The tables use only products, sums and quotients, which are the same on
all machines.
"""

from typing import Any

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.extras import require

CAP = 15
"""Larger magnitudes have an escape code."""
N_PARAMETERS = 32
MAX_SHIFT = 22
UNUSED = MAX_SHIFT + 1
"""In place of the shift, for a kind that has no numbers."""
MAX_ESCAPE_BITS = 20
LARGEST = 2**40


def _probability_tables() -> FloatArray:
    """Probabilities of magnitudes from 0 to CAP for all parameters. *Shape:* ``(zero, ratio, CAP + 1)``."""
    odds, ratio = [0.03125], (np.arange(N_PARAMETERS) + 0.5) / N_PARAMETERS
    for _ in range(N_PARAMETERS - 1):  # up to 1,000
        odds.append(odds[-1] * 1.4)
    sizes = [np.ones(N_PARAMETERS)]
    for _ in range(CAP - 1):
        sizes.append(sizes[-1] * ratio)
    total = sum(sizes[1:], sizes[0])
    zero = np.array([each / (1 + each) for each in odds])
    nonzero = np.stack([size / total for size in sizes], 1)
    table = np.empty((N_PARAMETERS, N_PARAMETERS, CAP + 1))
    table[:, :, 0] = zero[:, None]
    table[:, :, 1:] = (1 - zero)[:, None, None] * nonzero[None]
    return table


TABLES = _probability_tables()
COSTS = -np.log2(TABLES)
COSTS[:, :, 1:] += 1  # the sign


def _library() -> Any:
    return require("constriction", "compress", "a small file of a motion").stream


def _fitted(numbers: IntArray) -> tuple[int, int, int]:
    """The shift and the two parameters that take the fewest bits."""
    best, found = np.inf, (0, 0, 0)
    for shift in range(MAX_SHIFT + 1):
        magnitudes = np.abs(_upper(numbers, shift))
        if int(magnitudes.max()) >= 1 << MAX_ESCAPE_BITS:
            continue
        escaped = magnitudes[magnitudes >= CAP] - CAP
        # The length of each escape code, and its bits but the first.
        extra = float(np.log2(np.maximum(escaped, 1)).sum()) + len(escaped) * np.log2(MAX_ESCAPE_BITS + 1)
        costs = COSTS @ np.bincount(np.minimum(magnitudes, CAP), minlength=CAP + 1)
        place = int(costs.argmin())
        total = float(costs.flat[place]) + extra + shift * len(numbers)
        if total < best:
            best, found = total, (shift, *divmod(place, N_PARAMETERS))
        if not magnitudes.any():
            break
    return found


def _upper(numbers: IntArray, shift: int) -> IntArray:
    return (numbers + ((1 << shift) >> 1)) >> shift


def _model(stream: Any, zero: int, ratio: int) -> Any:
    probabilities = TABLES[zero, ratio]
    one_sign = 0.5 * probabilities[1:]
    return stream.model.Categorical(np.concatenate([one_sign[::-1], probabilities[:1], one_sign]), perfect=False)


class IntegerEncoder:
    """Integers to bytes."""

    def __init__(self) -> None:
        self._stream = _library()
        self._coder = self._stream.queue.RangeEncoder()

    def write(self, numbers: IntArray, kinds: IntArray, n_kinds: int) -> None:
        """Append numbers, each of a kind that the decoder knows too. *Shape:* ``(n,), (n,)``.

        Raises:
            ValueError: A number is too large.
        """
        if int(np.abs(numbers).max(initial=0)) >= LARGEST:
            raise ValueError("numbers are too large to be packed: the error is too small for such coordinates")
        for kind in range(n_kinds):
            own = numbers[kinds == kind]
            model = _fitted(own) if len(own) else (UNUSED, 0, 0)
            self._write_uniform([model[0]], UNUSED + 1)
            if len(own):
                self._write_uniform(model[1:], N_PARAMETERS)
                self._write_kind(own, *model)

    def _write_kind(self, numbers: IntArray, shift: int, zero: int, ratio: int) -> None:
        upper = _upper(numbers, shift)
        self._coder.encode((np.clip(upper, -CAP, CAP) + CAP).astype(np.int32), _model(self._stream, zero, ratio))
        if shift:
            self._write_uniform(numbers + (1 << shift >> 1) - (upper << shift), 1 << shift)
        for size in (np.abs(upper[np.abs(upper) >= CAP]) - CAP).tolist():
            n = size.bit_length()
            self._write_uniform([n], MAX_ESCAPE_BITS + 1)
            if n > 1:
                self._write_uniform([size - (1 << n - 1)], 1 << n - 1)

    def _write_uniform(self, values: Any, size: int) -> None:
        self._coder.encode(np.asarray(values, dtype=np.int32), self._stream.model.Uniform(size))

    def data(self) -> bytes:
        """All that was written."""
        return self._coder.get_compressed().astype("<u4").tobytes()


class IntegerDecoder:
    """Bytes to integers.

    Raises:
        ValueError: In any method, if the bytes are damaged.
    """

    def __init__(self, data: bytes) -> None:
        if len(data) % 4:
            raise ValueError("its numbers are cut off")
        self._stream = _library()
        self._coder = self._stream.queue.RangeDecoder(np.frombuffer(data, "<u4").astype(np.uint32))

    def read(self, kinds: IntArray, n_kinds: int) -> IntArray:
        """The numbers that :meth:`IntegerEncoder.write` appended."""
        numbers = np.zeros(len(kinds), dtype=np.int64)
        try:
            for kind in range(n_kinds):
                own = kinds == kind
                shift = int(self._read_uniform(1, UNUSED + 1)[0])
                if (shift == UNUSED) != (not own.any()):
                    raise ValueError("its numbers are damaged")
                if shift != UNUSED:
                    numbers[own] = self._read_kind(int(own.sum()), shift, *self._read_uniform(2, N_PARAMETERS).tolist())
        except AssertionError:
            raise ValueError("its numbers are damaged") from None
        return numbers

    def _read_kind(self, count: int, shift: int, zero: int, ratio: int) -> IntArray:
        upper = self._coder.decode(_model(self._stream, zero, ratio), count).astype(np.int64) - CAP
        low = self._read_uniform(count, 1 << shift) if shift else 0
        for i in np.flatnonzero(np.abs(upper) >= CAP).tolist():
            n = int(self._read_uniform(1, MAX_ESCAPE_BITS + 1)[0])
            size = int(self._read_uniform(1, 1 << n - 1)[0]) + (1 << n - 1) if n > 1 else n
            upper[i] += np.sign(upper[i]) * size
        return (upper << shift) + low - (1 << shift >> 1)

    def _read_uniform(self, count: int, size: int) -> IntArray:
        return self._coder.decode(self._stream.model.Uniform(size), count).astype(np.int64)
