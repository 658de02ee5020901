"""Loads a plugin, a Python file with marked functions, and words its exceptions for the user.

Names of NEST 2 are explained where an error follows from them. Source: NEST's own "Reference guide:
NEST 2.x vs NEST 3.0", and what 3.10 has removed.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import sys
import traceback
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.errors import NO_WAITING, NeurosError, NodeError, PluginError
from neuros.hooks import HookSpec, hook_specs_of
from neuros.project.model import Node

PREFIX = "neuros_plugin_"
"""Of the last word in the module name of each plugin."""

_GONE_MODULES = {
    "neuros.gazebo": "MuJoCo stands in for Gazebo, and reads its SDF files: use MuJoCo(node, path)"
    " of neuros.simulators.mujoco in its place",
}


def load_plugin(node: Node) -> Sequence[HookSpec]:
    """Import the plugin of a node under a name of the node's own, and return its hooks in order.

    A plugin whose hooks depend on the ports of its node has a function ``neuros_hooks(node)``. It
    gets the node as its file declares it, and returns marked functions.

    A module of an installed package is imported anew, too, within its package; what it
    imports itself is shared with the other nodes of the process.

    Raises:
        PluginError: if it cannot be imported (with the traceback from the plugin on), or
            declares no hooks.
        HookError: if one of its hooks is declared wrongly.
    """
    path, module_name = node.plugin, node.module
    package, name = module_name.rpartition(".")[0], f"{PREFIX}{node.name}"
    if module_name and path == Path():
        raise no_module(module_name)
    full_name = f"{package}.{name}" if package else name
    folders = [str(path.parent)] if path.name == "__init__.py" and module_name else None
    spec = importlib.util.spec_from_file_location(
        full_name, path, submodule_search_locations=folders
    )
    if spec is None or spec.loader is None:
        raise PluginError(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[full_name] = module
    # NEST has all libraries after it share their symbols. Then of two ROS messages with one name
    # (KeyValue, GoalStatus) the second is taken for the first.
    flags = sys.getdlopenflags()
    try:
        if package:
            importlib.import_module(package)
        spec.loader.exec_module(module)
        functions: Mapping[Any, Any] = vars(module)
        if make := functions.get("neuros_hooks"):
            functions = {**functions, **dict(enumerate(make(node)))}
    except NeurosError:
        raise
    except BaseException as error:
        if isinstance(error, ModuleNotFoundError) and error.name in _GONE_MODULES:
            raise PluginError(
                f"{path}: there is no {error.name}: {_GONE_MODULES[error.name]}"
            ) from error
        line = ""
        if isinstance(error, SyntaxError) and error.filename == str(path):
            line = f":{error.lineno}"
        raise PluginError(
            f"{path}{line}: cannot be imported: {describe(error)}\n{plugin_traceback(error, path)}"
        ) from error
    finally:
        sys.setdlopenflags(flags)
    specs = hook_specs_of(functions)
    if not specs:
        raise PluginError(
            f"{path}: declares no hooks: mark functions with @neuros_function or @neuros_tick"
            " from neuros.hooks"
        )
    return specs


def no_module(name: str) -> PluginError:
    """The error for a plugin that is a module which this Python lacks."""
    return PluginError(
        f"there is no module {name} for {sys.executable}: its package goes into the"
        " requirements.txt of the node's container: docs/plugins.md"
    )


def describe(error: BaseException) -> str:
    """An exception in one line: its type, the first line of its text, and what helps, if known."""
    if isinstance(error, NodeError):  # its text is written for the user
        return str(error).partition("\n")[0]
    lines = "".join(traceback.format_exception_only(type(error), error)).splitlines()
    # A syntax error shows the place first, indented.
    line = next(line for line in lines if line and not line.startswith(" ")).strip()
    hint = nest2_hint(error, line.partition(": ")[2]) or _hint(error)
    return f"{line} ({hint})" if hint else line


def _hint(error: BaseException) -> str:
    if isinstance(error, ModuleNotFoundError) and error.name is not None:
        top = error.name.partition(".")[0]
        return (
            f"packages such as {top} go into the requirements.txt of the node's container, modules"
            " of your own beside the plugin: docs/containers.md#environments-without-docker"
        )
    frames = traceback.extract_tb(error.__traceback__)
    if any(frame.name == "get_global_executor" for frame in frames):  # by rclpy.spin and the like
        return NO_WAITING
    file = error.filename if isinstance(error, FileNotFoundError) else None
    if isinstance(file, str | bytes) and file and not os.path.isabs(file):
        if frames and frames[-1].filename.endswith("/subprocess.py"):
            return ""  # it is a program, and is looked for on the PATH
        name, folder = os.fsdecode(file), os.path.realpath("/proc/self/cwd")
        return (
            f"relative to the current folder, which is {folder}; a file beside the plugin, or of"
            f" the project, is node.resolve_path({name!r})"
        )
    return ""


def last_line(error: BaseException, where: str) -> str:
    """``file:line`` of the innermost call in the file of ``where``, else ``where`` itself."""
    file = where.rpartition(":")[0]
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
    return f"{file}:{lines[-1]}" if lines else where


def plugin_traceback(error: BaseException, plugin: Path) -> str:
    """The traceback from the first frame inside the plugin on; all of it if there is none.

    The errors that led to this one are shown before it, as Python does.
    """
    shown = traceback.TracebackException.from_exception(error)
    each: traceback.TracebackException | None = shown
    while each is not None:
        names = [frame.filename for frame in each.stack]
        if str(plugin) in names:
            del each.stack[: names.index(str(plugin))]
        each = each.__cause__ or each.__context__
    return "".join(shown.format()).rstrip()


# ------------------------------------------------------------------ names of NEST 2

MODELS: Mapping[str, str] = {
    "spike_detector": "spike_recorder",
    "iaf_neuron": "iaf_psc_alpha",
    "aeif_cond_alpha_RK5": "aeif_cond_alpha",
    "iaf_psc_alpha_presc": "iaf_psc_alpha_ps",
    "iaf_psc_alpha_canon": "iaf_psc_alpha_ps",
    "iaf_psc_delta_canon": "iaf_psc_delta_ps",
    "stdp_nn_pre-centered_synapse": "stdp_nn_pre_centered_synapse",
}
FUNCTIONS: Mapping[str, str] = {
    "ResetNetwork": "ResetKernel",
    "PrintNetwork": "PrintNodes",
    "LayoutNetwork": "Create",
    "GetLeaves": "GetNodes",
    "GetChildren": "GetNodes",
    "GetLid": "GetLocalNodeCollection",
    "GetLID": "GetLocalNodeCollection",
    "FindConnections": "GetConnections",
    "DataConnect": "Connect",
    "CGConnect": "Connect",
    "OneToOneConnect": "Connect",
    "ConvergentConnect": "Connect",
    "DivergentConnect": "Connect",
    "RandomConvergentConnect": "Connect",
    "RandomDivergentConnect": "Connect",
    "DisconnectOneToOne": "Disconnect",
    "CreateLayer": "Create",
    "ConnectLayers": "Connect",
    "GetLayer": "GetNodes",
    "GetElement": "GetNodes",
    "PlotKernel": "PlotProbabilityParameter",
}
PARAMETERS: Mapping[str, str] = {
    "model": "synapse_model",
    "autapses": "allow_autapses",
    "multapses": "allow_multapses",
    "allow_offgrid_spikes": "allow_offgrid_times",
    "to_file": "record_to",
    "to_memory": "record_to",
    "to_screen": "record_to",
    "grng_seed": "rng_seed",
    "rng_seeds": "rng_seed",
    "time": "biological_time",
}
"""Of nodes, connections and the kernel; ``record_to`` takes ``"ascii"``, ``"memory"``, ...."""
_SUBNETS = "NEST 3 has no subnets: what `Create` returns can be sliced and joined"
_SLI = "NEST 3 has no SLI: the functions of `nest` take its place"
_ALWAYS = "NEST 3 always records it: leave it out"
_GONE_FROM_NEST: Mapping[str, str] = {
    **dict.fromkeys(
        ("subnet", "BeginSubnet", "EndSubnet", "CurrentSubnet", "ChangeSubnet", "GetNetwork"),
        _SUBNETS,
    ),
    **dict.fromkeys(("sli_run", "sli_func", "sli_push", "sli_pop", "sr", "sps", "spp"), _SLI),
    **dict.fromkeys(("withtime", "withgid"), _ALWAYS),
    "topology": "NEST 3 has it in `nest`: Create(..., positions=nest.spatial.grid(...))",
    "hl_api": "NEST 3 has its functions in `nest`",
    "kernel": "NEST 3 has its errors in `nest.NESTErrors`",
}
_TODAY: Mapping[str, str] = {
    **{old: f"NEST 3 calls it {new}" for old, new in {**MODELS, **FUNCTIONS, **PARAMETERS}.items()},
    **_GONE_FROM_NEST,
}


def nest2_hint(error: BaseException, text: str) -> str:
    """A hint for an error whose text names something of NEST 2; ``""`` for another."""
    if names := [name for name in _names(error, text) if name in _TODAY]:
        return "; ".join(f"{name} is of NEST 2: {_TODAY[name]}" for name in dict.fromkeys(names))
    takes_collections = isinstance(error, AttributeError) and error.name in ("get", "set")
    if takes_collections and _is_raised_in_nest(error):
        return "NEST 3 takes what `Create` returned, and no list of numbers"
    return ""


def _names(error: BaseException, text: str) -> Iterable[str]:
    """The names in the text of an error, if it is about NEST."""
    if type(error).__module__ == "NESTErrors":
        if text.startswith("Unaccessed elements"):
            return text.rpartition(":")[2].split()
        return [name for name in re.findall(r"[\w-]+", text) if name not in PARAMETERS]
    quoted = [name.rpartition(".") for name in re.findall(r"['`]([\w.-]+)['`]", text)]
    is_about_nest = any("nest" in (package, name) for package, _, name in quoted)
    if is_about_nest or text.startswith("Connect()") or _is_raised_in_nest(error):
        return [name for _, _, name in quoted]
    return []


def _is_raised_in_nest(error: BaseException) -> bool:
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and "-packages/nest/" in frames[-1].filename
