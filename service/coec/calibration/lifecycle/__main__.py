"""`python -m coec.calibration.lifecycle > docs/health.md`: a page of the documentation, from the tables in the code."""

import sys

from coec.calibration.lifecycle.page import page

sys.stdout.write(page())
