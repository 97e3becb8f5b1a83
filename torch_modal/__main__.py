"""``python -m torch_modal`` is ``torch-modal``."""

import sys

from torch_modal.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
