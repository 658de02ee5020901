"""``neuros export``: its options, and the command."""

from __future__ import annotations

import argparse
import os
import re
from dataclasses import dataclass, replace

from neuros.api.request import ProjectOptions, Request
from neuros.cli.common import add_project, load_with_messages
from neuros.errors import UsageError
from neuros.options import like, option, parsed_as, positive_number

FORMS = ("compose", "kubernetes", "slurm")
_LABEL = "[a-z0-9](?:[a-z0-9-]*[a-z0-9])?"
_CLAIM = re.compile(rf"(?=.{{1,253}}$){_LABEL}(?:\.{_LABEL})*")  # RFC 1123
# https://github.com/distribution/reference: a host, or a part of the path, and further parts.
_PART = r"[a-z0-9]+(?:(?:\.|__?|-+)[a-z0-9]+)*"
_HOST = rf"(?:(?i:{_LABEL}(?:\.{_LABEL})*)|\[[0-9A-Fa-f:]+\])(?::[0-9]+)?"
_REGISTRY = re.compile(rf"(?:{_HOST}|{_PART})(?:/{_PART})*/?")


def _placed(text: str) -> tuple[str, int]:
    node, _, number = text.rpartition("=")
    try:
        if node:
            return node, int(number)
    except ValueError:  # more digits than a number may have, too
        pass
    raise argparse.ArgumentTypeError(f"'{text}': give NODE=NUMBER, as in robot=1")


@dataclass(frozen=True, kw_only=True)
class ExportOptions(ProjectOptions):
    """How to export a project: for which engine, and how its nodes find each other there."""

    form: str = option(help="for which engine: compose, kubernetes or slurm", default="compose")
    output: str | os.PathLike[str] | None = like(
        Request,
        "output",
        default_help="<project>-<engine> in the current folder",
        help="write the files into this folder, which must be new or empty",
    )
    duration: float | str | None = like(Request, "duration")
    domain_id: int | None = like(Request, "domain_id", default_help="0")
    peers: str | None = like(
        Request,
        "peers",
        default_help="the names of the containers; with --host-network, multicast finds them",
        help="name the machines on which nodes look for each other",
    )
    peer_timeout: int = option(
        "--peer-timeout",
        parse=positive_number,
        metavar="SECONDS",
        default=600,
        help="let each node end with exit code 4 if the others were not found after this time;"
        " images may have to be pulled first",
    )
    host_network: bool = option(
        "--host-network",
        default=False,
        help="let containers use the network of their machine; not for kubernetes",
    )
    registry: str | None = option(
        "--registry",
        metavar="PREFIX",
        help="put this in front of the names of images, so that other machines can pull them:"
        " registry.lab/robots, for example",
    )
    volume_claim: str | None = option(
        "--volume-claim",
        metavar="NAME",
        default_help="they go with the pods",
        help="for kubernetes: keep run folders in this PersistentVolumeClaim",
    )
    place: tuple[tuple[str, int], ...] = option(
        "--place",
        parse=_placed,
        metavar="NODE=NUMBER",
        default_help="beside the launcher, on the first, 0",
        is_repeatable=True,
        help="for slurm: run this node of the project on this node of the allocation",
    )
    spread: bool = option(
        "--spread",
        default=False,
        help="for slurm: run each node of the project on its own node of the allocation",
    )


def check_names(options: ExportOptions) -> None:
    """Raise ``UsageError`` for a registry or a claim that an engine would refuse later."""
    if options.registry and not _REGISTRY.fullmatch(options.registry):
        raise UsageError(
            f"--registry {options.registry!r}: no name of an image can begin so: give a registry"
            " and a path in lower case, as in registry.lab:5000/robots"
        )
    if options.volume_claim and not _CLAIM.fullmatch(options.volume_claim):
        raise UsageError(
            f"--volume-claim {options.volume_claim!r}: is no name for Kubernetes: give lower case"
            " letters, digits, - and ., at most 253, with a letter or digit at both ends"
        )


def add_export(export: argparse.ArgumentParser) -> None:
    export.description = (
        "Write the files with which Docker Compose or Kubernetes start a project, without NeuROS on"
        " their machines; each node gets a container. Or write a batch script that launches the"
        " project on Slurm."
    )
    export.add_argument("form", choices=FORMS, help="for which engine")
    add_project(export, ExportOptions)
    export.set_defaults(command=_export)


def _export(parsed: argparse.Namespace) -> int:
    from neuros.cli.environments import build_messages
    from neuros_cluster.export import export

    project, messages = load_with_messages(parsed)
    if ended := build_messages(messages):
        return ended
    options = replace(parsed_as(ExportOptions, parsed), form=parsed.form)
    print(export(project, messages.paths, options))
    return 0
