"""``python -m torchrl_nerd.cli``, the same as ``nerd``."""

import sys

from torchrl_nerd.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
