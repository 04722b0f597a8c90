"""`python -m coec`."""

import sys

from coec.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
