"""``neuros convert``: converts SDF or URDF to MJCF, MuJoCo's own format."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.errors import EnvironmentFault, UsageError

if TYPE_CHECKING:
    from neuros_robots.mjcf import Converted

_EPILOG = """\
exit codes:
  0    done; elements that were not converted are listed
  2    wrong usage
  3    the description is wrong: every problem is listed with its file and line
  4    the file cannot be written, or MuJoCo is not installed
"""


def add_convert(convert: argparse.ArgumentParser) -> None:
    convert.description = (
        "Turn a robot or a world in SDF (1.4 to 1.11), or a robot in URDF, into a MuJoCo model"
        " (MJCF), and list what MuJoCo has no counterpart for."
    )
    convert.epilog = _EPILOG
    convert.add_argument(
        "file", metavar="FILE", help="an SDF or URDF file, or a folder with a model.config"
    )
    convert.add_argument(
        "-o", "--output", metavar="FILE", help="what to write (default: the name with .xml)"
    )
    convert.add_argument(
        "-I",
        "--include",
        action="append",
        default=[],
        metavar="DIR",
        help="look for model:// and package:// in this folder (repeatable), before those in"
        " SDF_PATH, GZ_SIM_RESOURCE_PATH, GAZEBO_MODEL_PATH and ROS_PACKAGE_PATH",
    )
    convert.add_argument(
        "--force", action="store_true", help="overwrite a file that this command has not written"
    )
    convert.set_defaults(command=_convert)


def _convert(options: argparse.Namespace) -> int:
    converted, source, output = _converted(options)
    try:
        from neuros_robots.mjcf import write_mjcf

        files = write_mjcf(converted, source, output)
    except OSError as error:
        raise EnvironmentFault(f"{output}: cannot be written: {error.strerror}") from error
    if converted.differences:
        from tabulate import tabulate

        rows = [
            [note.place, note.path, f"{note.count} x" if note.count > 1 else "", note.why]
            for note in converted.differences
        ]
        headers = ["where", "what", "", "reason, or what is different"]
        print(tabulate(rows, headers=headers, disable_numparse=True), end="\n\n")
    made = len(files) - 1
    meshes = f", {made} mesh{'' if made == 1 else 'es'} beside it" if made else ""
    print(f"{output}: bodies: {converted.bodies}, joints: {converted.joints}{meshes}")
    if converted.differences:
        count = sum(note.count for note in converted.differences)
        things = "1 thing was" if count == 1 else f"{count} things were"
        text = f"warning: {things} not converted, or converted differently: see the table"
        print(text, file=sys.stderr)
    return 0


def _converted(options: argparse.Namespace) -> tuple[Converted, Path, Path]:
    try:
        from neuros_robots.elements import NotFound, finder
        from neuros_robots.mjcf import is_ours
        from neuros_robots.sdf import convert_sdf, model_file
        from neuros_robots.urdf import read_urdf
    except ImportError as error:
        text = f"neuros convert needs MuJoCo: `pip install mujoco` ({error})"
        raise EnvironmentFault(text) from error
    named = Path(options.file)
    try:
        named.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise UsageError(f"{named}: there is no such file") from None
    try:
        source = model_file(named)
    except NotFound as error:
        raise UsageError(str(error)) from None
    output = Path(options.output) if options.output else source.with_suffix(".xml")
    if os.path.exists(output) and not output.is_file():
        raise UsageError(f"{output}: is not a file; name the file to write")
    if os.path.exists(output) and not options.force and not is_ours(output):
        raise UsageError(
            f"{output}: exists, and was not written by this command: name another"
            " file, or give --force"
        )
    folders = [Path(folder) for folder in options.include]
    for folder in folders:
        if not folder.is_dir():
            raise UsageError(f"-I {folder}: there is no such folder")
    convert = read_urdf if source.suffix.lower() in (".urdf", ".xacro") else convert_sdf
    return convert(source, finder(folders, os.environ)), source, output
