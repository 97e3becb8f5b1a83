"""What is expensive to make, kept for a while."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

from torch_modal.geometry.functions import lasting


class Recent:
    """The few most recently used of what is expensive to make."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The thing of this key, made where it is not kept; see :func:`lasting`."""
        if key not in self._kept:
            while len(self._kept) >= self.limit:  # before making, so that there are never more
                self._kept.popitem(last=False)
            self._kept[key] = lasting(make)()
        self._kept.move_to_end(key)
        return self._kept[key]

    def __len__(self) -> int:
        return len(self._kept)
