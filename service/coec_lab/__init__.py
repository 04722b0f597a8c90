"""The laboratory: what proves coec, and no vehicle runs. Simulator, experiments, benchmark and demonstrations."""

import logging

# Without a home directory, matplotlib warns about where it keeps fonts, which is of no interest here.
logging.getLogger("matplotlib").setLevel(logging.ERROR)
