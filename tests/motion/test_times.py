"""Times: their check, even times between them, and the interval of a time."""

from typing import Any

import pytest
import torch

from torch_modal.times import check_times, fill_linear, locate_times

F64 = torch.float64
CYCLE = torch.tensor([1.0, 2.0, 4.0], dtype=F64)


@pytest.mark.parametrize(
    ("times", "options", "said"),
    [
        ([0, 1], {}, r"must be 3 ascending numbers, one for each key-frame; got shape \(2,\)"),
        ([[0, 1, 2]], {}, r"got shape \(1, 3\)"),
        ([0, 1, 2], {"cyclic": True}, "must be 4 ascending numbers, .* and one when the first comes again"),
        (range(5), {"cyclic": None, "of": "frame"}, "must be 3 or 4 ascending numbers, one for each frame; got shape"),
        ([0, 2, 1], {}, "got 1 at place 2, after 2"),
        ([0, 1, 1], {}, "got 1 at place 2, after 1"),
        ([torch.nan, 1, 2], {}, "got nan at place 0$"),
        ([0, 1, torch.inf], {}, "got inf at place 2, after 1"),
    ],
)
def test_times_that_cannot_be_used_are_refused(times: Any, options: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        check_times(times, 3, **options)


def test_times_are_given_even_or_those_of_a_cycle() -> None:
    assert check_times(None, 3).tolist() == [0, 1, 2] and check_times(None, 3, True).tolist() == [0, 1, 2, 3]
    assert check_times(range(4), 3, None).dtype == F64 and len(check_times([5], 1)) == 1


def test_times_are_even_within_intervals() -> None:
    assert fill_linear(CYCLE, [0, 2, 6]).tolist() == [1, 1.5, 2, 2.5, 3, 3.5, 4]


@pytest.mark.parametrize(
    ("t", "cyclic", "interval", "fraction"),
    [
        (1, False, 0, 0),
        (1.25, False, 0, 0.25),
        (2, False, 1, 0),
        (4, False, 1, 1),
        (4, True, 0, 0),
        (-0.5, True, 1, 0.25),
    ],
)
def test_each_time_lies_in_one_interval(t: float, cyclic: bool, interval: int, fraction: float) -> None:
    found = locate_times(torch.tensor([t], dtype=F64), CYCLE, cyclic)
    assert [float(part) for part in found] == [interval, fraction]


def test_a_time_outside_names_both_ends() -> None:
    with pytest.raises(ValueError, match=r"first and the last frame, 1 and 4; got 4\.5"):
        locate_times(torch.tensor([2, 4.5], dtype=F64), CYCLE, False, of="frame")
