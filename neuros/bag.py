"""Recorded packets of a run, as NumPy arrays, pandas frames and xarray datasets.

::

    import neuros.bag

    with neuros.bag.open("runs/whiskeye/2026-11-21T15-00-00.000000Z") as bag:
        imu = bag["robot.imu"].array()            # structured array, one row per packet
        speed = imu["linear_acceleration.x"]
        frame = bag["/clock"].frame()             # pandas, if it is installed
        images = bag["robot.camera"].xarray()     # xarray, if it is installed
"""

import os
import warnings

from neuros.recording.bag_reader import Bag, RecordedTopic, open_bag


def open(run: str | os.PathLike[str]) -> Bag:
    """Open the bag of a run; one that was cut off is completed first.

    Warns where packets are missing that were there when the run ended.

    Args:
        run: the run folder, or a rosbag2 folder.

    Raises:
        UsageError: if there is none, or this version of NeuROS cannot read it.
        EnvironmentFault: if it is damaged.
    """
    bag = open_bag(run)
    if bag.damage is not None:
        warnings.warn(bag.damage, stacklevel=2)
    return bag


__all__ = ["Bag", "RecordedTopic", "open"]
