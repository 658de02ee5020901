"""The file with NeuROS's settings of Fast DDS, as Fast DDS itself reads it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from neuros.transport.dds_profile import (
    LOCAL_PROFILES,
    PROFILES,
    PROFILES_VARIABLE,
    RANGE_VARIABLE,
)

CREATE_A_NODE = "import rclpy; rclpy.init(); rclpy.create_node('reader_of_settings')"


def what_fast_dds_says_to(file: Path, discovery: str) -> str:
    environment = {**os.environ, PROFILES_VARIABLE: str(file), RANGE_VARIABLE: discovery}
    command = [sys.executable, "-c", CREATE_A_NODE]
    result = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True, timeout=30
    )
    return result.stdout + result.stderr


@pytest.mark.parametrize(
    ("file", "discovery"), [(PROFILES, "LOCALHOST"), (LOCAL_PROFILES, "SYSTEM_DEFAULT")]
)
def test_fast_dds_reads_the_files_and_finds_nothing_wrong(
    file: Path, discovery: str, tmp_path: Path
) -> None:
    misspelt = tmp_path / "misspelt.xml"
    misspelt.write_text(file.read_text().replace("nackSup", "nackSupp"))
    assert "XMLPARSER" in what_fast_dds_says_to(misspelt, discovery)
    assert "XMLPARSER" not in what_fast_dds_says_to(file, discovery)
