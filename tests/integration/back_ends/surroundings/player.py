"""Plays ball, and looks at its surroundings at every stroke.

Strokes count once the callbacks of both players have run: until then the ball only warms them up.
"""

import os
import subprocess
from pathlib import Path

import shared

from neuros.hooks import Optional, neuros_finalise, neuros_function, neuros_initialise

NAME = os.environ["WHO"]
SERVES = "SERVES" in os.environ
WARMING_UP, OTHER_IS_READY, PLAYING = range(3)  # what a ball says
STROKES = 0
IS_READY = False

os.environ["SET_ON_IMPORT"] = NAME
print(f"print on import: {NAME}")


@neuros_initialise(outputs=Optional("ball"))
def serve(node):
    note(node, "initialise")
    look(node)

    def on_timer():
        global IS_READY
        IS_READY = True
        timer.cancel()
        look(node)
        print(f"print in a callback: {NAME}")

    timer = node.get_ros_node().create_timer(0.001, on_timer)
    return node.make_packet("ball") if SERVES else None


@neuros_function(inputs="ball", outputs=Optional("ball"))
def hit(node, ball):
    global STROKES
    if ball.data != PLAYING:
        if not SERVES:
            ball.data = OTHER_IS_READY if IS_READY else WARMING_UP
        elif IS_READY and ball.data == OTHER_IS_READY:
            ball.data = PLAYING
        return ball
    STROKES += 1
    shared.calls.append(node.name)
    look(node)
    os.environ["SET_IN_HOOK"] = NAME
    print(f"print in hook: {NAME}")
    subprocess.run(["sh", "-c", 'echo "child of $WHO, home $HOME"'], check=True)
    node.get_logger().info(f"log in hook: {NAME}")
    if STROKES == 5 and SERVES:
        node.shutdown("enough")
        return None
    return ball


@neuros_finalise()
def end(node):
    look(node)
    note(node, f"finalise after {STROKES} strokes and {len(shared.calls)} calls")
    print(f"print at the end: {NAME}")


def look(node):
    assert node.name == NAME == os.environ["WHO"] == os.environ["SET_ON_IMPORT"]
    assert os.environ.get("SET_IN_HOOK", NAME) == NAME
    assert set(shared.calls) <= {NAME}
    assert Path.cwd() == node.run_dir.parent
    assert node.run_dir == Path(os.environ["NEUROS_RUN_DIR"])


def note(node, text):
    with open(node.run_dir / "notes", "a") as file:
        file.write(text + "\n")
