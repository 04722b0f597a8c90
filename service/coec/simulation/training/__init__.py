"""The depth network `street` of the package: rendered streets, the network, its training, its export.

It has seen no photograph. Anyone can train it again (with the extras `sim` and `train`; an hour on two cores):

    python -m coec.simulation.training render FRAMES
    python -m coec.simulation.training train FRAMES street.pt
    python -m coec.simulation.training export street.pt street.onnx
    coec models assess street.onnx 'sim:seed=77&seconds=80&camera_hz=0.1&lidar_hz=0.1'

`recipe` draws cameras, mounts, light and dirt, `places` where they stand, `shown` says what a frame is, `files` keeps
frames; `augment` changes them each time they are shown; `network` and `loss` are what `train` trains; `export` writes
ONNX. Frames are the same for the same seeds. The weights are not to the byte: they depend on the processor, and those
that are shipped were trained while the recipe grew (its first 1,400 steps saw streets only, 2,700 of 4,900 smaller
pictures, and the learning rate fell twice).
"""
