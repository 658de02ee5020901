import time

from neuros.hooks import neuros_tick

TICKS = 6


@neuros_tick(sim_seconds=0.1)
def think(node):
    time.sleep(0.02)  # slow: packets of the clock pile up meanwhile
    node.get_logger().info(f"at {node.sim_time:.2f} s")
    if node.sim_time > (TICKS - 0.5) * 0.1:
        node.shutdown()
