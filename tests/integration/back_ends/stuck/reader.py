"""Says that it computes, leaves a file, then computes in C for ever."""

import ctypes

from neuros.hooks import neuros_tick


@neuros_tick(seconds=0.1)
def read(node):
    compute(node)


def compute(node):
    node.get_logger().info("computing")
    (node.run_dir / "seen").touch()
    ctypes.PyDLL(None).sleep(3600)
