"""The built-in depth network `street`: its rendered streets, the network, its training, its export.

It was trained without any photograph. Anyone can train it again (extra `train` of coec-lab; an hour on two cores):

    python -m coec_lab.training render FRAMES
    python -m coec_lab.training train FRAMES street.pt
    python -m coec_lab.training export street.pt street.onnx
    coec models assess street.onnx 'sim:seed=77&seconds=80&camera_hz=0.1&lidar_hz=0.1'

`training_scenes` draws cameras, mounts, light and dirt, and where they stand; `training_frames` defines a frame and
stores frames; `augment` changes them each time they are shown; `train` trains `network`; `network.export` writes
ONNX. The same seeds give the same frames, but not the same weights to the byte: weights depend on the processor, and
the shipped ones were trained while the recipe grew (the first 1,400 steps saw streets only, 2,700 of 4,900 saw smaller
pictures, and the learning rate fell twice).
"""
