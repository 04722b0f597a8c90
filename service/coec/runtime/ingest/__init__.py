"""From a sample to a pair: inbox, decoder, buffer, the clock of the sensors, statistics of the streams."""
