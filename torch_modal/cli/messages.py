"""Messages of the command line on the error output, one line each."""

import argparse
import contextlib
import logging
import sys
import warnings
from collections.abc import Iterator
from typing import Any

PROGRAM = "torch-modal"


def say(message: str) -> None:
    """Print a line."""
    print(f"{PROGRAM}: {message}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Show each warning about input or result once, as one line; ignore those of libraries."""
    seen = set()

    def show(message: Warning | str, category: type[Warning], *_: Any) -> None:
        text = " ".join(str(message).split())
        if issubclass(category, UserWarning) and text not in seen:
            seen.add(text)
            say(f"warning: {text}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield


@contextlib.contextmanager
def log_as_lines(args: argparse.Namespace) -> Iterator[None]:
    """Show the package's log on the error output: progress, warnings only with --quiet, all with --verbose."""
    logger = logging.getLogger("torch_modal")
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter(f"{PROGRAM}: %(message)s"))
    level = logger.level
    verbose, quiet = (getattr(args, name, False) for name in ("verbose", "quiet"))
    logger.setLevel(logging.DEBUG if verbose else logging.WARNING if quiet else logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
