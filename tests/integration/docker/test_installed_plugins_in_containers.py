"""A plugin of a package that is installed in the image of its container, and nowhere else."""

from __future__ import annotations

import json
import uuid
from pathlib import Path

import pytest
from launching import launch
from packages import make_wheel

from containers import nothing_left, require_containers
from neuros.cli.main import main

PLUGIN = """
from neuros.hooks import neuros_initialise

@neuros_initialise()
def begin(node):
    node.shutdown(f"begun in {__file__}")
"""
RECIPE = """
FROM neuros_python
USER 0
COPY *.whl /tmp/
RUN pip install --no-index /tmp/lab_plugin-1.0-py3-none-any.whl
USER 1000:1000
"""


@pytest.mark.acceptance
@pytest.mark.docker
def test_it_runs_where_its_container_has_it(tmp_path: Path) -> None:
    require_containers("neuros_python")
    name = f"test_{uuid.uuid4().hex[:10]}"
    container = tmp_path / "containers" / name
    make_wheel(container, "lab_plugin", "1.0", PLUGIN)
    (container / "Dockerfile").write_text(RECIPE)
    nodes = [{"name": "a", "container": name, "plugin": "lab_plugin"}]
    (tmp_path / "project.json").write_text(json.dumps({"nodes": nodes}))
    assert main(["containers", "build", str(tmp_path)]) == 0
    try:
        with nothing_left(tmp_path):
            run = launch(tmp_path, "--backend", "docker", cwd=tmp_path, timeout_s=120)
    finally:
        assert main(["containers", "remove", name]) == 0
    assert run.exit_code == 0, run.output
    assert "a ended the project: begun in /opt/neuros/lib/python" in run.output
