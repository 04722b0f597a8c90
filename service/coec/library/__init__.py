"""The flow of a calibration for its two callers: a program that imports coec, and the command line.

Programs may rely on what `coec` itself names (`coec.__all__`); the modules here may change.
"""
