"""The program of a node's process or container: composes runtime and transport."""

from __future__ import annotations

import argparse
import faulthandler
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from neuros.ports import Middleware
from neuros.project.model import NodeFile
from neuros.project.split import node_file_from_json
from neuros.runtime.process import NodeProcess


def run_node(options: argparse.Namespace) -> int:
    """Run the nodes of the given ``node.json`` files until they are asked to end."""
    faulthandler.enable()  # a plugin that crashes in C leaves its Python stack in the log
    files = [node_file_from_json(json.loads(Path(p).read_text())) for p in options.node_files]
    # ROS tools started by a plugin must find the same ROS, so only the guard is taken away.
    os.environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)

    def make_middleware(
        files: Sequence[NodeFile], on_failure: Callable[[BaseException], None]
    ) -> Middleware:
        from neuros.transport.ros_process import RosProcess

        return RosProcess(files, on_failure, in_memory=options.in_memory, debug=options.debug)

    return NodeProcess(
        files,
        make_middleware,
        duration_sim_s=options.duration_sim,
        own_logs=options.in_memory,
    ).run()
