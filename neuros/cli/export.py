"""``neuros export``, and ``neuros part``, which the containers of an exported project start."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from neuros.api.request import FORMS, ExportOptions, Request
from neuros.cli.launch import signals_noted
from neuros.cli.projects import add_project, load_with_messages
from neuros.options import add_options, options_of, parsed_as, values_of

_OF_PARTS = ("domain_id", "peers", "peer_timeout", "duration", "output", "verbose")
_EXIT_CODES = {2: 130, 15: 143, 1: 143}


def add_export(export: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    export.description = (
        "Write the files with which Docker Compose, Docker Swarm or Kubernetes start a project,"
        " without NeuROS on their machines; each node gets a container. Or write a batch script"
        " that launches the project on Slurm."
    )
    export.add_argument("form", choices=FORMS, help="for which engine")
    add_project(export, ExportOptions)
    export.set_defaults(command=_export)


def _export(parsed: argparse.Namespace) -> int:
    from neuros.api.export import export
    from neuros.cli.environments import build_messages

    project, messages = load_with_messages(parsed)
    if ended := build_messages(messages):
        return ended
    options = replace(parsed_as(ExportOptions, parsed), form=parsed.form)
    print(export(project, messages.paths, options))
    return 0


def add_part(part: argparse.ArgumentParser) -> None:
    """Add the arguments of the program."""
    part.add_argument("file", type=Path)
    part.add_argument("node")
    add_options(part, [each for each in options_of(Request) if each.name in _OF_PARTS])
    part.set_defaults(command=_part)


def _part(parsed: argparse.Namespace) -> int:
    """Start one node of an exported project, and be a peer of the others; returns the exit code."""
    with signals_noted() as (signals, waker):
        from neuros.api.execution import Execution
        from neuros.api.part import part_plan, reach_peers, read_parts
        from neuros.errors import EnvironmentFault

        declared = [each for each in options_of(Request) if each.name in _OF_PARTS]
        request = Request(
            nodes=(parsed.node,), backend="process", network=True, **values_of(declared, parsed)
        )
        project = read_parts(parsed.file)
        try:
            network = reach_peers(request.peers, request.peer_timeout, signals)
        except EnvironmentFault:
            if signals:
                return _EXIT_CODES[signals[0]]
            raise
        plan = part_plan(project, network, request)
        return int(Execution(plan, sys.stdout, signals, waker).run()["exit_code"])
