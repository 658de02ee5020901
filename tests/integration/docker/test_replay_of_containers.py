"""``neuros replay RUN --node NAME`` of runs in containers: a process of this machine."""

from __future__ import annotations

from pathlib import Path

import pytest
from replaying import MIXER, Recorded, assert_identical, copied, record, replay

from containers import nothing_left, require_containers


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    require_containers()
    folder = tmp_path_factory.mktemp("recorded")
    with nothing_left(folder):
        return record(folder, "docker")


@pytest.fixture
def own(recorded: Recorded, tmp_path: Path) -> Recorded:
    """The same run, with a project that a test may change."""
    return copied(recorded, tmp_path)


@pytest.mark.parametrize("name", ["counter", "mixer"])
def test_every_node_does_and_sends_the_same_again(recorded: Recorded, name: str) -> None:
    """The counter reads a file that its environment names by the path in its container."""
    done = replay(recorded.run, name)
    assert done.returncode == 0, done.stdout + done.stderr
    assert_identical(recorded, name, done.stdout)


def test_it_needs_no_engine(recorded: Recorded) -> None:
    done = replay(recorded.run, "mixer", DOCKER_HOST="unix:///nonexistent")
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_changed_plugin_is_told_with_its_path_on_this_machine(own: Recorded) -> None:
    plugin = own.project / "mixer.py"
    plugin.write_text(MIXER.replace("seen[0] % 1000", "seen[0] % 1000 + (seen[0] > 20)"))
    done = replay(own.run, "mixer")
    assert done.returncode == 1, done.stdout + done.stderr
    assert f"note: {plugin} was changed after the run had begun" in done.stdout
    assert "different: mixer.mixed -> counter.back: packet " in done.stdout


def test_requirements_that_cannot_be_had_here(own: Recorded, tmp_path: Path) -> None:
    container = own.project / "containers/neuros_python"
    container.mkdir(parents=True)
    (container / "requirements.txt").write_text("neuros-is-nowhere\n")
    done = replay(
        own.run,
        "mixer",
        PIP_NO_INDEX="1",
        PIP_FIND_LINKS=str(tmp_path),
        XDG_CACHE_HOME=str(tmp_path / "cache"),
    )
    assert done.returncode == 4, done.stdout + done.stderr
    assert f"in {own.run} 'mixer' ran in a container; a replay runs as a process" in done.stderr
    assert f"{container / 'requirements.txt'} is not satisfied here" in done.stderr


def test_a_module_that_was_in_the_image_and_is_not_here(own: Recorded) -> None:
    (own.project / "mixer.py").write_text("import neuros_is_nowhere\n" + MIXER)
    done = replay(own.run, "mixer")
    assert done.returncode == 4, done.stdout + done.stderr
    assert "No module named 'neuros_is_nowhere': install it for " in done.stderr
