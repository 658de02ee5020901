"""What runs in containers need: a Docker engine that may be used, and images that are built."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from importlib.util import find_spec

from neuros.doctor.findings import Finding, absent, bad, good
from neuros.errors import EnvironmentFault


def look_at_containers(names: Sequence[str], environ: Mapping[str, str]) -> Iterator[Finding]:
    """The engine and, if it answers, the images of containers of NeuROS's own."""
    if find_spec("docker") is None:
        yield absent("Docker", "its Python package is not installed", "run ./install.py")
        return
    from neuros.launch.docker.engine import connect, engine_faults
    from neuros.launch.docker.images import image_for

    try:
        engine = connect(environ)
    except EnvironmentFault as fault:
        yield absent("Docker", str(fault))
        return
    with closing(engine):
        try:
            with engine_faults("the engine"):
                version = engine.version()
            yield good("Docker", f"engine {version['Version']}, API {version['ApiVersion']}")
        except EnvironmentFault as fault:
            yield bad("Docker", str(fault))
            return
        for name in names:
            try:
                image = image_for(name, None, engine)
            except EnvironmentFault as fault:
                yield absent("image", str(fault))
                continue
            python = "{}.{}".format(*image.python_version)
            if image.notice:
                yield absent("image", image.notice)
            else:
                yield good("image", f"{image.name}, Python {python}")
