"""The flow of a calibration for whoever calls it: a program that imports coec, and the command line."""
