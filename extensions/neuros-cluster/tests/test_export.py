"""``neuros export``: what the files for Compose and Kubernetes say of a project."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from neuros_cluster.command import ExportOptions
from neuros_cluster.export import export
from neuros_cluster.part import part_plan, parts_to_json, reach_peers, read_parts

from neuros.api.plan import Network
from neuros.api.request import Request
from neuros.cli.main import main
from neuros.errors import EnvironmentFault, NeurosError, ProjectError, UsageError
from neuros.project.load import load_project
from neuros.project.model import Folders, Project
from neuros.project.split import split

OLDEST_KUBERNETES, NEWEST_KUBERNETES = "1.27", "1.37"
PLUGIN = """
from neuros.hooks import neuros_function

@neuros_function({declared})
def work(node, *packets):
    pass
"""
EYES = {"name": "eyes", "type": "std_msgs/msg/Int32"}
THROWER = {
    "name": "The_Thrower",
    "container": "neuros_python",
    "plugin": "thrower.py",
    "outputs": [EYES],
    "environment": {"SEED": "1", "TABLE": "#table.txt"},
    "resources": {"memory": "512m", "cpus": 1.5, "pids": 64},
}
COUNTER = {
    "name": "counter",
    "container": "neuros_mujoco",
    "plugin": "counter.py",
    "inputs": [EYES],
}


def project_in(folder: Path, **more: Any) -> Project:
    """A thrower with limits, and a counter, in the folder ``dice``; ``more``: of the thrower."""
    made = folder / "dice"
    made.mkdir()
    (made / "thrower.py").write_text(PLUGIN.format(declared='outputs="eyes"'))
    (made / "counter.py").write_text(PLUGIN.format(declared='inputs="eyes"'))
    (made / "table.txt").write_text("1 2 3")
    (made / "runs").mkdir()
    (made / "runs" / "large").write_text("what an earlier run has left")
    connection = {"source_node": "The_Thrower", "source_output": "eyes", "discard_limit": 0,
                  "destination_node": "counter", "destination_input": "eyes"}  # fmt: skip
    content = {
        "nodes": [{**THROWER, **more}, COUNTER],
        "connections": [connection],
        "budgets": {"tick_error_ms": 3, "lost_packets": {"The_Thrower.eyes -> counter.eyes": 0}},
        "namespace": "/table",
    }
    (made / "project.json").write_text(json.dumps(content))
    return load_project(made, workspace=folder).project


@pytest.fixture
def project(tmp_path: Path) -> Project:
    return project_in(tmp_path)


def exported(project: Project, form: str, **options: Any) -> list[dict[str, Any]]:
    """The YAML documents that an export has written."""
    folder = project.folder.parent / form
    file = export(project, (), ExportOptions(form=form, output=folder, **options))
    assert file.parent == folder
    return list(yaml.safe_load_all(file.read_text("utf-8")))


def services(project: Project, form: str, **options: Any) -> Mapping[str, Any]:
    (document,) = exported(project, form, **options)
    found: Mapping[str, Any] = document["services"]
    return found


def test_each_node_is_a_service_that_is_not_started_again_and_looks_for_the_others(
    project: Project,
) -> None:
    found = services(project, "compose", duration=3)
    assert [*found] == ["the-thrower", "counter"]
    command = " ".join(found["the-thrower"]["command"])
    assert command.startswith("The_Thrower -d 0 ")
    assert command.endswith(" --peer-timeout 600 --peers counter --duration 3")
    assert "--peers the-thrower" in " ".join(found["counter"]["command"])
    for service in found.values():
        assert service["healthcheck"]["test"][-3].endswith("/control.sock")
        assert service["restart"] == "no"


def test_limits_of_a_node_are_those_of_its_container(project: Project) -> None:
    thrower = services(project, "compose")["the-thrower"]
    assert (thrower["mem_limit"], thrower["cpus"], thrower["pids_limit"]) == ("512m", 1.5, 64)
    assert thrower["memswap_limit"] == thrower["mem_limit"]
    *_, job, _ = exported(project, "kubernetes")
    (container,) = job["spec"]["template"]["spec"]["containers"]
    assert container["resources"]["limits"] == {"cpu": "1.5", "memory": str(512 << 20)}


def test_a_node_gets_no_right_that_it_has_no_need_of(project: Project) -> None:
    for service in services(project, "compose").values():
        assert (service["cap_drop"], service["read_only"]) == (["ALL"], True)


@pytest.mark.parametrize("version", [OLDEST_KUBERNETES, NEWEST_KUBERNETES])
def test_what_kubernetes_gets_keeps_to_its_schemas(project: Project, version: str) -> None:
    documents = exported(project, "kubernetes", volume_claim="runs")
    assert [d["kind"] for d in documents] == ["ConfigMap", "Service", "Job", "Job"]
    for document in documents:
        kubernetes_validate.validate(document, version, strict=True)


def test_pods_find_each_other_by_the_names_that_indexed_jobs_have_with_a_headless_service(
    project: Project,
) -> None:
    configuration, service, thrower, counter = exported(project, "kubernetes")
    assert service["spec"]["clusterIP"] == "None"
    assert service["spec"]["publishNotReadyAddresses"]
    for job, other in ((thrower, counter), (counter, thrower)):
        pod = job["spec"]["template"]
        assert service["spec"]["selector"].items() <= pod["metadata"]["labels"].items()
        assert job["spec"]["completionMode"] == "Indexed"
        assert (job["spec"]["backoffLimit"], pod["spec"]["restartPolicy"]) == (0, "Never")
        assert pod["spec"]["subdomain"] == service["metadata"]["name"]
        host = f"{other['metadata']['name']}-0.{service['metadata']['name']}"
        assert f"--peers {host}" in " ".join(pod["spec"]["containers"][0]["args"])
    assert json.loads(configuration["data"]["nodes.json"])["project"] == "dice"


def test_the_folder_holds_all_that_images_get_and_nothing_of_earlier_runs(
    project: Project,
) -> None:
    found = services(project, "compose", registry="registry.lab/robots/")
    folder = project.folder.parent / "compose"
    assert (folder / "image/project/table.txt").read_text() == "1 2 3"
    assert not (folder / "image/project/runs").exists()
    assert (folder / "image/lib/neuros/schema/project.schema.json").is_file()
    assert "COPY image /neuros" in (folder / "Dockerfile").read_text()
    assert found["counter"]["image"].startswith("registry.lab/robots/dice-neuros-mujoco:")
    assert found["counter"]["build"]["args"] == {"BASE": "neuros_mujoco:latest"}


def test_the_name_of_an_image_changes_with_what_is_in_it(tmp_path: Path) -> None:
    project = project_in(tmp_path)
    before = services(project, "compose")["counter"]["image"]
    same = export(project, (), ExportOptions(form="compose", output=tmp_path / "same"))
    assert yaml.safe_load(same.read_text("utf-8"))["services"]["counter"]["image"] == before
    (project.folder / "table.txt").write_text("4 5 6")
    again = export(project, (), ExportOptions(form="compose", output=tmp_path / "again"))
    assert yaml.safe_load(again.read_text("utf-8"))["services"]["counter"]["image"] != before


def test_a_part_reads_the_project_that_was_exported(project: Project) -> None:
    services(project, "compose")
    found = read_parts(project.folder.parent / "compose" / "nodes.json")
    thrower = found.node("The_Thrower")
    assert thrower.plugin == Path("/neuros/project/thrower.py")
    assert thrower.environment["TABLE"] == "/neuros/project/table.txt"
    assert found.connections == project.connections
    assert (found.budgets, found.names) == (project.budgets, project.names)
    plan = part_plan(found, Network(True), Request(nodes=("counter",)))
    assert (plan.names, plan.elsewhere) == (("counter",), ("The_Thrower",))


def test_a_part_of_another_project_is_refused_by_name(project: Project) -> None:
    with pytest.raises(UsageError, match="no such node: judge; the project has The_Thrower, count"):
        part_plan(project, Network(True), Request(nodes=("judge",)))


def test_a_file_that_is_no_export_is_named(tmp_path: Path) -> None:
    file = tmp_path / "nodes.json"
    for text in ("", "[]", '{"nodes": []}', '{"nodes": [{}]}'):
        file.write_text(text)
        with pytest.raises(UsageError, match=r"nodes\.json: not what `neuros export` writes"):
            read_parts(file)


def test_every_node_survives_the_way_through_the_file(project: Project, tmp_path: Path) -> None:
    folders = Folders(project.folder, tmp_path, tmp_path)
    (tmp_path / "nodes.json").write_text(
        json.dumps(parts_to_json(project, split(project, lambda _: folders)))
    )
    found = read_parts(tmp_path / "nodes.json")
    assert found.nodes == project.nodes


@pytest.mark.parametrize(
    ("form", "wish", "named"),
    [
        ("compose", {"display": True}, "asks for display, and compose has none"),
        ("kubernetes", {"devices": ["/dev/null"]}, "asks for devices, and kubernetes has none"),
        ("kubernetes", {"display": True}, "asks for display, and kubernetes has none"),
    ],
)
def test_what_an_engine_cannot_give_to_a_node_is_refused(
    tmp_path: Path, form: str, wish: Mapping[str, Any], named: str
) -> None:
    project = project_in(tmp_path, **wish)
    with pytest.raises(UsageError, match=f"node 'The_Thrower' {named}"):
        exported(project, form)


def test_devices_and_gpus_go_into_the_compose_file(tmp_path: Path) -> None:
    project = project_in(tmp_path, devices=["/dev/null"], gpus=["0", "1"])
    thrower = services(project, "compose")["the-thrower"]
    assert thrower["devices"] == ["/dev/null:/dev/null"]
    (gpu,) = thrower["deploy"]["resources"]["reservations"]["devices"]
    assert gpu == {"driver": "nvidia", "capabilities": ["gpu"], "device_ids": ["0", "1"]}


def test_a_machine_s_own_network_takes_no_names_of_containers(project: Project) -> None:
    counter = services(project, "compose", host_network=True, peers="10.0.0.7")["counter"]
    assert counter["network_mode"] == "host"
    assert "--peers 10.0.0.7" in " ".join(counter["command"])
    with pytest.raises(UsageError, match="--host-network: Kubernetes gives each pod an address"):
        exported(project, "kubernetes", host_network=True)


def test_a_folder_with_anything_in_it_is_not_written_to(project: Project) -> None:
    services(project, "compose")
    with pytest.raises(UsageError, match="is not an empty folder; name a new one"):
        exported(project, "compose")


def test_a_link_within_the_project_stands_for_a_copy_and_one_to_nothing_is_left_out(
    project: Project,
) -> None:
    (project.folder / ".kept").mkdir()
    (project.folder / ".kept" / "large").write_text("kept by a tool")
    (project.folder / "large").symlink_to(".kept/large")
    (project.folder / "again").symlink_to(project.folder / ".kept")
    (project.folder / "old_data").symlink_to("gone")
    assert services(project, "compose")
    copy = project.folder.parent / "compose" / "image" / "project"
    for name in ("large", "again/large"):
        assert (copy / name).read_text() == "kept by a tool"
        assert not (copy / name).is_symlink()
    assert {path.name for path in copy.iterdir()}.isdisjoint({"old_data", ".kept"})


def test_a_virtual_environment_in_the_project_is_left_out(project: Project) -> None:
    place = project.folder / "venv" / "bin"
    place.mkdir(parents=True)
    (place.parent / "pyvenv.cfg").touch()
    (place / "python").symlink_to(sys.executable)
    assert services(project, "compose")
    assert not (project.folder.parent / "compose/image/project/venv").exists()


def test_links_out_of_the_project_or_in_a_circle_and_devices_are_all_named_before_it_is_written(
    project: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret").write_text("of the machine")
    for name, target in {
        "conf": tmp_path / "secret",
        "data.bin": "/dev/zero",
        "home": "..",
        "old": "/gone",
        "a": ".",
        "b": ".",
        "left/back": "../right",
        "right/back": "../left",
    }.items():
        (project.folder / name).parent.mkdir(exist_ok=True)
        (project.folder / name).symlink_to(target)
    os.mkfifo(project.folder / "pipe")
    with pytest.raises(ProjectError) as raised:
        exported(project, "compose")
    instead = "put a copy in place of the link, or remove it"
    circle = f"leads back to a folder that it lies in: {instead}"
    away = "leads out of the project's folder, to"
    told = {str(problem).removeprefix("dice/") for problem in raised.value.problems}
    assert told == {
        f"a: {circle}",
        f"b: {circle}",
        f"conf: {away} {tmp_path}/secret: {instead}",
        f"data.bin: {away} /dev/zero: {instead}",
        f"home: {away} {tmp_path}: {instead}",
        f"left/back/back: {circle}",
        f"old: {away} /gone: {instead}",
        "pipe: is neither a file nor a folder: remove it",
        f"right/back/back: {circle}",
    }
    assert not (tmp_path / "compose").exists()


def test_links_that_stand_for_ever_more_files_are_refused(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuros.project.files_to_copy._MOST_LINKED", 1000)
    (project.folder / "d0").mkdir()
    for number in range(1, 40):
        folder = project.folder / f"d{number}"
        folder.mkdir()
        for name in ("a", "b"):
            (folder / name).symlink_to(f"../d{number - 1}")
    with pytest.raises(ProjectError, match="links stand for more than 1,000 files: put a copy"):
        exported(project, "compose")


def test_a_failed_export_leaves_nothing_behind(
    project: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(source: str, target: str, **_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copystat", full)
    output = tmp_path / "new"
    for was_there in (False, True):
        if was_there:
            output.mkdir()
        with pytest.raises(UsageError, match=r"cannot be copied: .*No space left"):
            export(project, [], ExportOptions(form="compose", output=str(output)))
        assert output.exists() == was_there
        assert not was_there or not any(output.iterdir())


def test_the_run_folder_may_have_any_name(project: Project) -> None:
    """As ``RUN`` is the user's, it is no part of what the shell reads."""
    _, shell, option, script, *arguments = services(project, "compose")["counter"]["healthcheck"][
        "test"
    ]
    assert "RUN" not in script
    assert "$$1" in script  # Compose makes $ of it
    assert "${RUN:-run}" in arguments[-1]
    made = project.folder / "a run; exit 7" / "counter"
    made.mkdir(parents=True)
    command = [shell, option, script.replace("$$", "$"), "sh", str(made)]
    assert subprocess.run(command, check=False).returncode == 1  # nothing listens in there
    assert subprocess.run([*command[:-1], f"{made} gone"], check=False).returncode == 0


def test_names_that_kubernetes_refuses_are_told_at_once(project: Project) -> None:
    long = replace(project.nodes[1], name="counter" * 9)
    project = replace(project, name="2_dice", nodes=(project.nodes[0], long))
    with pytest.raises(UsageError) as raised:
        exported(project, "kubernetes")
    told = str(raised.value).splitlines()
    assert [line.partition(" would be ")[0] for line in told] == [
        "project '2_dice'",
        f"node '{long.name}'",
    ]
    assert services(project, "compose")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"duration": "nan"}, "--duration nan: give seconds, such as 30, or simulated"),
        ({"duration": "2sim"}, "--duration in simulated time needs exactly one node that owns"),
        ({"domain_id": 9999}, "-d/--domain-id: '9999' is not a ROS domain id"),
        ({"peers": "10.0.0.7,a b"}, "'a b' is neither an IPv4 address nor the name of a host"),
    ],
)
@pytest.mark.parametrize("form", ["compose", "slurm"])
def test_what_a_launch_refuses_an_export_refuses(
    project: Project, form: str, options: Mapping[str, Any], told: str
) -> None:
    if form == "slurm" and "peers" in options:
        told = "--peers is not for slurm"
    with pytest.raises(NeurosError, match=re.escape(told)):
        export(project, (), ExportOptions(form=form, **options))
    assert not Path(f"dice-{form}").exists()


@pytest.mark.parametrize(
    "registry",
    ["registry.lab:5000/robots", "Registry.Lab/robots/", "me", "a_user", "[::1]:5000/a__b/c.d"],
)
def test_a_registry_is_the_beginning_of_an_image_s_name(project: Project, registry: str) -> None:
    image = services(project, "compose", registry=registry)["counter"]["image"]
    assert image.startswith(f"{registry.rstrip('/')}/dice-neuros-mujoco:")


@pytest.mark.parametrize("registry", ["a b", "lab/Robots", "https://lab", "lab//a", "lab:x/a", "-"])
def test_a_registry_that_no_image_can_have_is_refused(project: Project, registry: str) -> None:
    with pytest.raises(UsageError, match=f"--registry '{registry}': no name of an image"):
        exported(project, "compose", registry=registry)


@pytest.mark.parametrize("claim", ["runs\nx: y", "runs\n", "Runs", "-runs", "a..b", "r" * 254])
def test_a_claim_that_kubernetes_cannot_have_is_refused(project: Project, claim: str) -> None:
    with pytest.raises(UsageError, match=r"--volume-claim '.*': is no name for Kubernetes"):
        exported(project, "kubernetes", volume_claim=claim)
    assert exported(project, "kubernetes", volume_claim="runs.of-2026")


@pytest.mark.parametrize("number", [-1, 65_536, 99_999_999_999])
def test_a_node_is_placed_where_a_cluster_can_have_one(
    project: Project, tmp_path: Path, number: int
) -> None:
    with pytest.raises(UsageError, match=f"--place counter={number}: is no node of an allocation"):
        export(project, (), ExportOptions(form="slurm", place=(("counter", number),)))
    last = ExportOptions(form="slurm", place=(("counter", 65_535),), output=tmp_path / "job")
    assert "#SBATCH --nodes=65536\n" in export(project, (), last).read_text()


def test_a_job_has_the_project_s_name_without_what_slurm_would_read(
    project: Project, tmp_path: Path
) -> None:
    folder = project.folder.rename(tmp_path / "my dice\n#SBATCH --exclusive")
    project = replace(project, file=folder / project.file.name)
    script = export(project, (), ExportOptions(form="slurm", output=tmp_path / "job")).read_text()
    assert "#SBATCH --job-name=my-dice--SBATCH---exclusive\n" in script
    assert "#SBATCH --output=my-dice--SBATCH---exclusive-%j.log\n" in script


def test_an_invalid_project_is_not_exported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = project_in(tmp_path)
    (project.folder / "counter.py").unlink()
    assert main(["export", "compose", str(project.folder), "-o", str(tmp_path / "out")]) == 3
    assert "counter.py" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_name_that_is_never_known_ends_the_wait_and_a_signal_does_at_once() -> None:
    with pytest.raises(EnvironmentFault, match=r"the host 'nobody\.invalid' cannot be found"):
        reach_peers("nobody.invalid", None, [])
    with pytest.raises(EnvironmentFault):
        reach_peers("nobody.invalid", 3600, [15])
