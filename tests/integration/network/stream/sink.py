"""Notes the number and the age of each image: ``received.json``, ages in seconds.

Both namespaces are on one machine, so that its monotonic clock tells the age.
"""

import json
import time

from neuros.hooks import neuros_finalise, neuros_function

numbers, ages_s, times_s = [], [], []


@neuros_function(inputs="image")
def take(node, image):
    stamp = image.header.stamp
    times_s.append(time.monotonic())
    ages_s.append(times_s[-1] - stamp.sec - stamp.nanosec * 1e-9)
    assert not any(image.data)
    numbers.append(int(image.header.frame_id))
    if len(numbers) == 1:
        print("the first image is here", flush=True)


@neuros_finalise()
def note(node):
    took_s = times_s[-1] - times_s[0] if times_s else 0.0
    text = json.dumps({"numbers": numbers, "ages_s": ages_s, "took_s": took_s})
    (node.run_dir / "received.json").write_text(text)
