"""Draws the true, the estimated and the remembered heading and what the whiskers feel.

Tells at the end how far the robot's true heading is from the one that it remembered. Files in the
node's folder of the run: the figure, and ``homing.csv`` (true poses and touches, every digit).
"""

import csv
import math

from heading_error import yaw_of

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise
from neuros.time import to_nanoseconds, to_seconds
from neuros.visualise import VisualiseLines, VisualiseRotations

TRUTH, ESTIMATE, REMEMBERED = "true", "estimate", "remembered"
RIGHT, LEFT = "right whiskers", "left whiskers"
MEAN_OF = 25  # poses


class Homing:
    """Rows ``(stamp in ns, x in m, y in m, heading in rad, right in N, left in N)``; figures."""

    def __init__(self, node):
        self.rows = []
        self.remembered = None  # stamp in ns, heading in rad
        self.headings = VisualiseRotations("WhiskEye: back to a heading", duration=None, node=node)
        self.headings.add_radians(ESTIMATE, "C3")
        self.headings.add_quaternion(TRUTH, "k")
        self.headings.add_radians(REMEMBERED, "C0")
        self.touch = VisualiseLines("touch", None, y_label="N", below=self.headings)
        self.touch.add_line(RIGHT)
        self.touch.add_line(LEFT)

    def true_rad_at(self, stamp):
        """The mean true heading of the half second that ends with this stamp."""
        ends = next(n for n, row in enumerate(self.rows, 1) if row[0] == stamp)
        angles_rad = [row[3] for row in self.rows[max(0, ends - MEAN_OF) : ends]]
        return math.atan2(sum(map(math.sin, angles_rad)), sum(map(math.cos, angles_rad)))


@neuros_initialise()
def start(node):
    node.set_user_data(Homing(node))


@neuros_function(inputs=["truth", "touch"])
def show_truth(node, pose, touch):
    homing, stamp = node.get_user_data(), to_nanoseconds(pose)
    q, place, half = pose.pose.orientation, pose.pose.position, len(touch.data) // 2
    sides_n = sum(touch.data[:half]), sum(touch.data[half:])
    homing.rows.append((stamp, place.x, place.y, yaw_of(q.x, q.y, q.z, q.w), *sides_n))
    homing.headings.plot(TRUTH, q, stamp * 1e-9)
    for side, force_n in zip((RIGHT, LEFT), sides_n, strict=True):
        homing.touch.plot(side, force_n, stamp * 1e-9)
    if homing.remembered:
        homing.headings.plot(REMEMBERED, homing.remembered[1], stamp * 1e-9)


@neuros_function(inputs="estimate")
def show_estimate(node, estimate):
    angle_rad, time_s = estimate.vector.z, to_seconds(estimate)
    node.get_user_data().headings.plot(ESTIMATE, angle_rad, time_s)


@neuros_function(inputs="remembered")
def keep(node, remembered):
    node.get_user_data().remembered = to_nanoseconds(remembered), remembered.vector.z


@neuros_finalise()
def report(node):
    homing = node.get_user_data()
    if homing is None or not homing.rows:  # ended before the start
        return
    with (node.run_dir / "homing.csv").open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["stamp_ns", "x_m", "y_m", "heading_rad", "right_n", "left_n"])
        rows.writerows(homing.rows)
    if homing.remembered is None:  # ended before it drove
        return
    then_rad = homing.true_rad_at(homing.remembered[0])
    now_rad = homing.true_rad_at(homing.rows[-1][0])
    off_deg = math.degrees(math.remainder(now_rad - then_rad, math.tau))
    touched_s = 0.02 * sum(right_n + left_n > 0 for *_, right_n, left_n in homing.rows)
    node.set_result("return_error_deg", off_deg)
    node.set_result("touched_s", touched_s)
    homing.headings.caption(f"back at {off_deg:+.1f} deg from the remembered heading")
    node.get_logger().info(
        f"back at {off_deg:+.1f} deg from the remembered heading; touched for {touched_s:.2f} s"
    )
