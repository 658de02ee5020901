"""What a node does with memory that its packets have left."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

# As a node with a queue of images does: 16 of 0.9 MB are there, and another takes the place of one.
QUEUE_OF_IMAGES = """
import array, os, resource, sys
from neuros.cli.node import keep_freed_memory

os.environ.update(variable.split("=") for variable in sys.argv[1:])
keep_freed_memory()
image = bytes(921_600)
for _ in range(30):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    queue = [array.array("B", image) for _ in range(16)]
    queue.clear()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults_of_16_images(*variables: str) -> int:
    command = [sys.executable, "-c", QUEUE_OF_IMAGES, *variables]
    others = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))  # as Dask leaves there
    }
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=others)
    return int(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="glibc")
def test_packets_that_come_take_the_memory_of_those_that_went() -> None:
    pages = 921_600 // 4096
    assert page_faults_of_16_images() < pages
    assert page_faults_of_16_images("MALLOC_ARENA_MAX=2") > 8 * pages  # the user's own settings
