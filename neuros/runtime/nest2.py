"""Names of NEST 2 in a plugin: what they are called today, for the error that they lead to.

Source: NEST's own "Reference guide: NEST 2.x vs NEST 3.0", and what 3.10 has removed.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterable, Mapping

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
_SUBNETS = "today there are no subnets: what `Create` returns can be sliced and joined"
_SLI = "today there is no SLI: the functions of `nest` take its place"
_ALWAYS = "today it is recorded always: leave it out"
_GONE: Mapping[str, str] = {
    **dict.fromkeys(
        ("subnet", "BeginSubnet", "EndSubnet", "CurrentSubnet", "ChangeSubnet", "GetNetwork"),
        _SUBNETS,
    ),
    **dict.fromkeys(("sli_run", "sli_func", "sli_push", "sli_pop", "sr", "sps", "spp"), _SLI),
    **dict.fromkeys(("withtime", "withgid"), _ALWAYS),
    "topology": "today it is a part of `nest`: Create(..., positions=nest.spatial.grid(...))",
    "hl_api": "today its functions are those of `nest`",
    "kernel": "today its errors are `nest.NESTErrors`",
}
_TODAY: Mapping[str, str] = {
    **{old: f"today it is {new}" for old, new in {**MODELS, **FUNCTIONS, **PARAMETERS}.items()},
    **_GONE,
}


def nest2_hint(error: BaseException, text: str) -> str:
    """What helps where the text of an error names something of NEST 2; ``""`` where it does not."""
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
