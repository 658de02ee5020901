"""What a run has recorded, as NumPy arrays and pandas frames::

import neuros.bag

with neuros.bag.open("runs/whiskeye/2026-11-21T15-00-00.000000Z") as bag:
    imu = bag["robot.imu"].array()            # structured array, one row per packet
    speed = imu["linear_acceleration.x"]
    frame = bag["/clock"].frame()             # pandas, if it is installed
"""

from neuros.observe.bag.opened import Bag, RecordedTopic, open_bag

open = open_bag

__all__ = ["Bag", "RecordedTopic", "open"]
