"""From a sample to a pair of frames: inbox, sensors, intake, pairs, the clock of the sensors, statistics."""
