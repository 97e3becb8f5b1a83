"""A small cache of the most recently used objects.

cachetools.LRUCache makes room after the new object is made; ours before, so that large objects never exceed the limit.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

from torch_modal.autograd import lasting


class Recent:
    """The most recently used objects, up to a limit."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The object of a key; computed if it is not in the cache, as by :func:`lasting`."""
        if key not in self._kept:
            while len(self._kept) >= self.limit:  # before making, so that there are never more
                self._kept.popitem(last=False)
            self._kept[key] = lasting(make)()
        self._kept.move_to_end(key)
        return self._kept[key]

    def __len__(self) -> int:
        return len(self._kept)
