"""Whole numbers as bits: a range coder (of the library constriction) with a distribution for each kind of number.

A number has a part that is told and ``shift`` low bits that are not. The first follows a distribution of two
parameters, how likely zero is and how fast larger ones get rarer; what goes beyond its table is written out. Shift and
parameters of each kind are fitted to its numbers and stand before them. Tables are made by products, sums and
quotients, which are the same on all machines.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_modal.extras import require

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

CAP = 15
"""Larger parts are written out."""
N_PARAMETERS = 32
MOST_SHIFT = 22
UNUSED = MOST_SHIFT + 1
"""In the place of the shift of a kind that has no numbers."""
MOST_BITS = 20
"""Of what is written out."""
LARGEST = 2**40


def _tables() -> FloatArray:
    """Probabilities of sizes from 0 to CAP for all parameters. *Shape:* ``(zero, fall, CAP + 1)``."""
    odds, fall = [0.03125], (np.arange(N_PARAMETERS) + 0.5) / N_PARAMETERS
    for _ in range(N_PARAMETERS - 1):  # to 1,000
        odds.append(odds[-1] * 1.4)
    sizes = [np.ones(N_PARAMETERS)]
    for _ in range(CAP - 1):
        sizes.append(sizes[-1] * fall)
    total = sizes[0]
    for size in sizes[1:]:
        total = total + size
    zero = np.array([each / (1 + each) for each in odds])
    some = np.stack([size / total for size in sizes], 1)
    table = np.empty((N_PARAMETERS, N_PARAMETERS, CAP + 1))
    table[:, :, 0] = zero[:, None]
    table[:, :, 1:] = (1 - zero)[:, None, None] * some[None]
    return table


TABLES = _tables()
COSTS = -np.log2(TABLES)
COSTS[:, :, 1:] += 1  # the sign


def _library() -> Any:
    return require("constriction", "compress", "a small file of a motion").stream


def _fitted(numbers: IntArray) -> tuple[int, int, int]:
    """Shift and parameters with the fewest bits."""
    best, found = np.inf, (0, 0, 0)
    for shift in range(MOST_SHIFT + 1):
        size = np.abs(_upper(numbers, shift))
        if int(size.max()) >= 1 << MOST_BITS:
            continue
        told = np.bincount(np.minimum(size, CAP), minlength=CAP + 1)
        beyond = size[size >= CAP] - CAP
        # The length of what is written out, and its bits but the first.
        extra = float(np.log2(np.maximum(beyond, 1)).sum()) + len(beyond) * np.log2(MOST_BITS + 1)
        costs = COSTS @ told
        place = int(costs.argmin())
        total = float(costs.flat[place]) + extra + shift * len(numbers)
        if total < best:
            best, found = total, (shift, *divmod(place, N_PARAMETERS))
        if not size.any():
            break
    return found


def _upper(numbers: IntArray, shift: int) -> IntArray:
    return (numbers + ((1 << shift) >> 1)) >> shift


class Writer:
    """Numbers to bytes."""

    def __init__(self) -> None:
        self._stream = _library()
        self._coder = self._stream.queue.RangeEncoder()

    def numbers(self, numbers: IntArray, kinds: IntArray, n_kinds: int) -> None:
        """Append numbers, of which each is of a kind that the reader knows. *Shape:* ``(n,), (n,)``.

        Raises:
            ValueError: A number is too large.
        """
        if int(np.abs(numbers).max(initial=0)) >= LARGEST:
            raise ValueError("numbers are too large to be packed: the error is too small for such coordinates")
        for kind in range(n_kinds):
            own = numbers[kinds == kind]
            model = _fitted(own) if len(own) else (UNUSED, 0, 0)
            self._evenly([model[0]], UNUSED + 1)
            if len(own):
                self._evenly(model[1:], N_PARAMETERS)
                self._of_kind(own, model)

    def _of_kind(self, numbers: IntArray, model: tuple[int, int, int]) -> None:
        shift, zero, fall = model
        upper = _upper(numbers, shift)
        told = np.clip(upper, -CAP, CAP)
        self._coder.encode((told + CAP).astype(np.int32), _model(self._stream, zero, fall))
        if shift:
            low = numbers + (1 << shift >> 1) - (upper << shift)
            self._evenly(low, 1 << shift)
        for size in (np.abs(upper[np.abs(upper) >= CAP]) - CAP).tolist():
            n = size.bit_length()
            self._evenly([n], MOST_BITS + 1)
            if n > 1:
                self._evenly([size - (1 << n - 1)], 1 << n - 1)

    def _evenly(self, values: Any, size: int) -> None:
        self._coder.encode(np.asarray(values, dtype=np.int32), self._stream.model.Uniform(size))

    def data(self) -> bytes:
        """All that was written."""
        return self._coder.get_compressed().astype("<u4").tobytes()


class Reader:
    """The same numbers, of bytes.

    Raises:
        ValueError: Anywhere, that the bytes are damaged.
    """

    def __init__(self, data: bytes) -> None:
        if len(data) % 4:
            raise ValueError("its numbers are cut off")
        self._stream = _library()
        self._coder = self._stream.queue.RangeDecoder(np.frombuffer(data, "<u4").astype(np.uint32))

    def numbers(self, kinds: IntArray, n_kinds: int) -> IntArray:
        """What :meth:`Writer.numbers` wrote."""
        numbers = np.zeros(len(kinds), dtype=np.int64)
        try:
            for kind in range(n_kinds):
                own = kinds == kind
                shift = int(self._evenly(1, UNUSED + 1)[0])
                if (shift == UNUSED) != (not own.any()):
                    raise ValueError("its numbers are damaged")
                if shift != UNUSED:
                    zero, fall = self._evenly(2, N_PARAMETERS).tolist()
                    numbers[own] = self._of_kind(int(own.sum()), shift, zero, fall)
        except AssertionError:
            raise ValueError("its numbers are damaged") from None
        return numbers

    def _of_kind(self, count: int, shift: int, zero: int, fall: int) -> IntArray:
        upper = self._coder.decode(_model(self._stream, zero, fall), count).astype(np.int64) - CAP
        low = self._evenly(count, 1 << shift) if shift else 0
        for i in np.flatnonzero(np.abs(upper) >= CAP).tolist():
            n = int(self._evenly(1, MOST_BITS + 1)[0])
            size = int(self._evenly(1, 1 << n - 1)[0]) + (1 << n - 1) if n > 1 else n
            upper[i] += np.sign(upper[i]) * size
        return (upper << shift) + low - (1 << shift >> 1)

    def _evenly(self, count: int, size: int) -> IntArray:
        return self._coder.decode(self._stream.model.Uniform(size), count).astype(np.int64)


def _model(stream: Any, zero: int, fall: int) -> Any:
    sizes = TABLES[zero, fall]
    both = 0.5 * sizes[1:]
    return stream.model.Categorical(np.concatenate([both[::-1], sizes[:1], both]), perfect=False)
