"""The laboratory: what proves coec, and no vehicle runs. Simulator, experiments, benchmark and demonstrations."""
