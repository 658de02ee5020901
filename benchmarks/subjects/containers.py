"""What a container per node costs against a process per node: speed and start.

Left out where no Docker engine has the images of WhiskEye's nodes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import closing

from benchmarks.measure import Case, Figure, Group, Subject, Unavailable
from benchmarks.subjects.start_up import whiskeye_s
from benchmarks.subjects.whiskeye import RATE, SIMULATED_S, orchestrated
from neuros.errors import EnvironmentFault

IMAGES = ("neuros_python", "neuros_mujoco", "neuros_nest")
PROCESSES, CONTAINERS = "processes", "containers"


def subject(is_quick: bool) -> Subject:
    """Simulated seconds per run."""
    simulated_s = SIMULATED_S * (0.1 if is_quick else 1.0)
    speed = functools.partial(orchestrated, "strict", simulated_s=simulated_s)
    return Subject(
        "a container per node against a process per node",
        (
            Group(
                {
                    PROCESSES: functools.partial(speed, backend="process"),
                    CONTAINERS: functools.partial(_in_containers, speed),
                },
                (
                    Case(
                        "whiskeye strict in containers, real-time factor",
                        "",
                        Figure(CONTAINERS, RATE),
                        Figure(PROCESSES, RATE),
                        "processes",
                        "containers-speed",
                    ),
                ),
            ),
            Group(
                {CONTAINERS: functools.partial(_in_containers, whiskeye_s)},
                (
                    Case(
                        "launch of whiskeye in containers, first hook of the last node",
                        "s",
                        Figure(CONTAINERS, "last"),
                        bound="containers-first-hook",
                    ),
                ),
            ),
        ),
    )


def _in_containers(measure: Callable[..., dict[str, float]]) -> dict[str, float]:
    try:
        from neuros.backends.docker.engine import connect
        from neuros.backends.docker.images import images_for

        with closing(connect()) as engine:
            images_for(IMAGES, None, engine)
    except (EnvironmentFault, ModuleNotFoundError) as error:
        raise Unavailable(str(error)) from error
    return measure(backend="docker")
