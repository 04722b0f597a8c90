"""The flow of a calibration for whoever calls it: a program that imports coec, and the command line.

What others may rely on is what `coec` itself names (`coec.__all__`); the modules here may change.
"""
