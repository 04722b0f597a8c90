"""From a sample to a pair: inbox, sensors, intake, pairs, the clock of the sensors, statistics."""
