"""Which packages a project sees, in which order they are built, and what they are recognised by."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest
from message_packages import write_package

from neuros.caching import sweep
from neuros.errors import EnvironmentFault
from neuros.installation.progress import Progress
from neuros.messages import needed
from neuros.messages.needed import Compilers, Messages
from neuros.messages.package import find_packages
from neuros.messages.workspace import Built, Workspaces, message_cache
from neuros.project.message_types import unknown_type
from neuros.project.model import Node, Port

POINT = {"msg/Point.msg": "float64 x\n"}
MONTH_S = 31 * 24 * 3600


class Bench:
    """A project's workspace and NeuROS's, and a cache; nothing is compiled."""

    def __init__(self, folder: Path) -> None:
        self.own, self.shared, self.cache = folder / "own", folder / "shared", folder / "cache"

    @property
    def workspaces(self) -> Workspaces:
        return Workspaces(self.own, self.shared, {"XDG_CACHE_HOME": str(self.cache)})

    def messages(self, *names: str) -> Messages:
        workspaces = self.workspaces
        return Messages(workspaces, names or workspaces.packages)

    def key(self, name: str) -> str:
        """What the package is recognised by now."""
        folder = self.workspaces.installed(name)
        assert folder is not None
        return folder.name

    def problems(self) -> list[str]:
        return [str(problem) for problem in self.messages().problems()]


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


class TestFinding:
    def test_packages_are_found_at_any_depth(self, bench: Bench) -> None:
        write_package(bench.own / "src" / "group", "deep_msgs", POINT)

        (package,) = find_packages(bench.own)[0]

        assert package.name == "deep_msgs"
        assert package.files == (Path("msg/Point.msg"),)

    @pytest.mark.parametrize("ignored", ["build", "install", "log", ".git"])
    def test_what_colcon_makes_is_left_out(self, bench: Bench, ignored: str) -> None:
        write_package(bench.own / ignored, "old_msgs", POINT)

        assert find_packages(bench.own) == ([], [])

    def test_a_folder_can_be_left_out(self, bench: Bench) -> None:
        folder = write_package(bench.own, "old_msgs", POINT)
        (folder / "COLCON_IGNORE").touch()

        assert find_packages(bench.own) == ([], [])

    def test_packages_without_messages_are_none_of_its_business(self, bench: Bench) -> None:
        write_package(bench.own, "just_code", {})

        assert find_packages(bench.own) == ([], [])

    def test_where_there_is_no_workspace_there_are_no_packages(self, bench: Bench) -> None:
        assert bench.messages().built == []

    def test_the_project_s_own_package_comes_before_a_shared_one(self, bench: Bench) -> None:
        write_package(bench.own, "same_msgs", POINT)
        write_package(bench.shared, "same_msgs", {"msg/Other.msg": ""})

        assert bench.workspaces.messages("same_msgs") == {"Point"}


class TestOrder:
    def test_each_comes_after_those_that_it_needs(self, bench: Bench) -> None:
        write_package(bench.own, "a_msgs", POINT, ["b_msgs"])
        write_package(bench.own, "b_msgs", POINT, ["c_msgs", "std_msgs"])
        write_package(bench.shared, "c_msgs", POINT)

        built = bench.messages("a_msgs").built

        assert [each.package for each in built] == ["c_msgs", "b_msgs", "a_msgs"]

    def test_a_project_needs_its_own_and_the_shared_ones_of_its_ports(self, bench: Bench) -> None:
        write_package(bench.own, "own_msgs", POINT)
        write_package(bench.shared, "used_msgs", POINT)
        write_package(bench.shared, "other_msgs", POINT)
        port = Port("x", "used_msgs/msg/Point")
        node = Node("n", "neuros_python", Path("plugin.py"), inputs=(port,))

        built = Messages.of_nodes([node], bench.workspaces).built

        assert sorted(each.package for each in built) == ["own_msgs", "used_msgs"]

    def test_what_nobody_needs_is_not_even_read(self, bench: Bench) -> None:
        folder = write_package(bench.shared, "other_msgs", POINT)
        (folder / "package.xml").write_text("no manifest")
        node = Node(
            "n", "neuros_python", Path("plugin.py"), inputs=(Port("x", "std_msgs/msg/Bool"),)
        )

        assert Messages.of_nodes([node], bench.workspaces).problems() == []

    def test_packages_that_need_each_other_are_a_mistake(self, bench: Bench) -> None:
        write_package(bench.own, "a_msgs", POINT, ["b_msgs"])
        write_package(bench.own, "b_msgs", POINT, ["a_msgs"])

        (problem,) = bench.problems()

        assert "package.xml:1:1: found packages that need each other: " in problem
        assert "a_msgs -> b_msgs" in problem

    def test_a_package_that_only_messages_name_is_built_before_them(self, bench: Bench) -> None:
        write_package(bench.own, "a_msgs", {"msg/A.msg": "b_msgs/Point[3] p\n"})
        write_package(bench.shared, "b_msgs", POINT)

        assert [each.package for each in bench.messages("a_msgs").built] == ["b_msgs", "a_msgs"]


class TestKeys:
    """A package is built again when something has changed that matters, and only then."""

    @pytest.mark.parametrize("file", ["msg/Point.msg", "package.xml"])
    def test_it_changes_with_its_files(self, bench: Bench, file: str) -> None:
        folder = write_package(bench.own, "a_msgs", POINT)
        before = bench.key("a_msgs")
        (folder / file).write_text((folder / file).read_text() + "\n")

        assert bench.key("a_msgs") != before

    def test_it_changes_with_another_file(self, bench: Bench) -> None:
        folder = write_package(bench.own, "a_msgs", POINT)
        before = bench.key("a_msgs")
        (folder / "msg/More.msg").touch()

        assert bench.key("a_msgs") != before

    def test_it_changes_with_what_it_needs(self, bench: Bench) -> None:
        write_package(bench.own, "a_msgs", POINT, ["b_msgs"])
        other = write_package(bench.own, "b_msgs", POINT)
        before = bench.key("a_msgs")
        (other / "msg/Point.msg").write_text("float32 x\n")

        assert bench.key("a_msgs") != before

    def test_it_changes_with_what_only_its_messages_name(self, bench: Bench) -> None:
        write_package(bench.own, "a_msgs", {"msg/A.msg": "b_msgs/Point p\n"})
        other = write_package(bench.own, "b_msgs", POINT)
        before = bench.key("a_msgs")
        (other / "msg/Point.msg").write_text("float32 x\n")

        assert bench.key("a_msgs") != before

    def test_it_does_not_change_with_its_place_and_date(self, bench: Bench) -> None:
        write_package(bench.own, "a_msgs", POINT)
        before = bench.key("a_msgs")
        bench.own.rename(bench.shared)
        os.utime(bench.shared / "a_msgs/msg/Point.msg", (0, 0))

        assert bench.key("a_msgs") == before

    def test_it_does_not_change_with_files_that_do_not_matter(self, bench: Bench) -> None:
        folder = write_package(bench.own, "a_msgs", POINT)
        before = bench.key("a_msgs")
        (folder / "README.md").write_text("news")

        assert bench.key("a_msgs") == before


class TestMistakes:
    def test_all_mistakes_of_all_files_are_said_at_once(self, bench: Bench) -> None:
        files = {"msg/A.msg": "flaot64 x\n", "srv/B.srv": "int32 a\n---\nint32 B\n"}
        write_package(bench.own, "a_msgs", files)
        write_package(bench.shared, "b_msgs", {"msg/C.msg": "\nPoint p\n"})

        found = [
            problem.partition(": ")[0].partition("/shared/")[2] for problem in bench.problems()
        ]

        assert len(found) == 3
        assert "b_msgs/msg/C.msg:2:1" in found

    @pytest.mark.parametrize(
        ("field", "said"),
        [
            ("sensor_msgs/Imuu i", "expected a message of 'sensor_msgs' (did you mean 'Imu'?)"),
            (
                "sensr_msgs/Imu i",
                "is here (did you mean 'sensor_msgs'? If 'sensr_msgs' exists",
            ),
            (
                "no_such/X x",
                "is here (there is no package 'no_such'. If 'no_such' exists",
            ),
            ("Pint p", "expected a message of 'a_msgs' (did you mean 'Point'?)"),
        ],
    )
    def test_a_type_has_to_be_there(self, bench: Bench, field: str, said: str) -> None:
        files = {**POINT, "msg/A.msg": f"int32 ok\n{field}\n"}
        write_package(bench.own, "a_msgs", files, ["sensor_msgs"])

        (problem,) = bench.problems()

        assert "a_msgs/msg/A.msg:2:1: found '" in problem
        assert said in problem

    def test_a_dependency_through_another_package_is_no_mistake(self, bench: Bench) -> None:
        """As in mavros_msgs: ROS finds std_msgs through geometry_msgs, which the manifest names."""
        files = {"msg/A.msg": "std_msgs/Header header\ngeometry_msgs/Pose pose\n"}
        write_package(bench.own, "a_msgs", files, ["geometry_msgs"])

        assert bench.problems() == []
        (doubt,) = bench.messages().doubts()
        said = "a_msgs/package.xml:1:1: no <depend>std_msgs</depend>, and message files use"
        assert said in str(doubt)

    def test_messages_in_a_folder_of_another_name_are_named_with_it(self, bench: Bench) -> None:
        write_package(bench.own, "a_msgs", {"messages/A.msg": "int32 a\n", "messages/B.msg": ""})

        (problem,) = bench.problems()

        assert "a_msgs/messages/A.msg:1:1: found A.msg in the folder 'messages', " in problem
        assert "expected it in the folder 'msg' beside package.xml (and 1 more)" in problem

    def test_a_field_whose_message_is_in_another_folder_says_where(self, bench: Bench) -> None:
        files = {"msg/A.msg": "Deep d\n", "msg/more/Deep.msg": "int32 a\n"}
        write_package(bench.own, "a_msgs", files)

        (problem,) = bench.problems()

        assert "a_msgs/msg/A.msg:1:1: found 'a_msgs/Deep', expected a message of" in problem
        assert "(found Deep.msg in the folder 'msg/more', expected it in the folder" in problem

    def test_a_port_whose_message_is_in_another_folder_says_where(self, bench: Bench) -> None:
        write_package(bench.own, "a_msgs", {**POINT, "other/Deep.msg": "int32 a\n"})

        found = unknown_type("a_msgs/msg/Deep", must_be_here=True, packages=bench.workspaces)

        assert found is not None
        assert found[1].startswith("found Deep.msg in the folder 'other'")

    def test_message_files_of_a_package_that_builds_none_are_left_alone(self, bench: Bench) -> None:
        folder = write_package(bench.own, "just_code", {"test/A.msg": "int32 a\n"})
        text = (folder / "package.xml").read_text()
        for name in ("rosidl_interface_packages", "rosidl_default_generators"):
            text = text.replace(name, "something_else")
        (folder / "package.xml").write_text(text)

        assert find_packages(bench.own) == ([], [])

    def test_a_message_cannot_contain_itself(self, bench: Bench) -> None:
        files = {"msg/A.msg": "B b\n", "msg/B.msg": "A a\n"}
        write_package(bench.own, "a_msgs", files)

        (problem,) = bench.problems()

        assert "found a message that contains itself: A -> B -> A" in problem

    def test_what_cannot_be_read_is_said(self, bench: Bench) -> None:
        folder = write_package(bench.own, "a_msgs", POINT)
        (folder / "msg" / "Lost.msg").symlink_to("nowhere")

        (problem,) = bench.problems()

        assert "a_msgs/msg/Lost.msg:1:1: cannot be read: " in problem

    @pytest.mark.parametrize(
        ("name", "said"),
        [
            ("std_msgs", " of a package of ROS"),
            ("random", " of a module of Python"),
            ("import", ", expected one that is not a keyword"),
            ("rover-msgs", ", expected a letter, then letters"),
        ],
    )
    def test_a_name_may_be_taken(self, bench: Bench, name: str, said: str) -> None:
        write_package(bench.own, name, POINT)

        said = f"found the name '{name}'{said}"
        assert any(said in problem for problem in bench.problems())

    def test_a_manifest_that_is_no_xml_is_said_with_its_line(self, bench: Bench) -> None:
        folder = write_package(bench.own, "a_msgs", POINT)
        (folder / "package.xml").write_text("<package>\n  <name>a_msgs\n</package>\n")

        (problem,) = bench.problems()

        assert problem.partition("a_msgs/package.xml:")[2].startswith("3:1: ")

    def test_a_name_that_is_too_long_for_files_is_told(self, bench: Bench) -> None:
        write_package(bench.own, "a" * 200, POINT)
        write_package(bench.own, "b" * 201, POINT)

        (problem,) = bench.problems()

        text = "the name of the package has 201 characters, at most 200 are allowed"
        assert problem.endswith(f"{'b' * 201}/package.xml:1:1: {text}")

    def test_a_manifest_that_lacks_something_says_what(self, bench: Bench) -> None:
        folder = write_package(bench.own, "a_msgs", POINT)
        text = (folder / "package.xml").read_text()
        (folder / "package.xml").write_text(text.replace("<license>MIT</license>", ""))

        (problem,) = bench.problems()

        assert "license" in problem

    def test_two_packages_of_one_name_are_a_mistake(self, bench: Bench) -> None:
        write_package(bench.own / "one", "a_msgs", POINT)
        write_package(bench.own / "two", "a_msgs", POINT)

        (problem,) = bench.problems()

        assert "found the package 'a_msgs' twice" in problem

    def test_what_is_built_is_not_checked_again(self, bench: Bench) -> None:
        write_package(bench.own, "a_msgs", {"msg/A.msg": "flaot64 x\n"})
        (built,) = bench.messages().built
        built.folder.mkdir(parents=True)

        assert bench.problems() == []


class TestBuilding:
    def test_what_is_changed_meanwhile_is_not_kept(
        self, bench: Bench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        file = write_package(bench.own, "a_msgs", POINT) / "msg/Point.msg"
        messages = bench.messages()
        compilers = Compilers("gcc", "g++", ())
        monkeypatch.setattr(Compilers, "here", lambda: compilers)
        monkeypatch.setattr(needed._Builder, "_generate", lambda *_: file.write_text("float32 x\n"))
        for part in ("_compile", "_install"):
            monkeypatch.setattr(needed._Builder, part, lambda *_: None)

        with pytest.raises(EnvironmentFault, match="'a_msgs' was changed while it was built"):
            messages.make(Progress(io.StringIO()), {})

        assert not messages.is_made
        bench.messages().make(Progress(io.StringIO()), {})
        assert bench.messages().is_made


class TestCache:
    def entry(self, bench: Bench, name: str, age_s: float) -> Built:
        environ: Mapping[str, str] = {"XDG_CACHE_HOME": str(bench.cache)}
        built = Built(message_cache(environ) / f"{name}-0123456789ab")
        built.folder.mkdir(parents=True)
        now_s = built.folder.stat().st_mtime
        os.utime(built.folder, (now_s - age_s, now_s - age_s))
        return built

    def test_what_nobody_uses_is_removed(self, bench: Bench) -> None:
        old, new = self.entry(bench, "a_msgs", MONTH_S), self.entry(bench, "b_msgs", 0)

        sweep(old.folder.parent)

        assert [path.name for path in old.folder.parent.iterdir()] == [new.folder.name]

    def test_a_half_that_is_left_of_it_does_not_count_as_built(
        self, bench: Bench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        old = self.entry(bench, "a_msgs", MONTH_S)
        monkeypatch.setattr(shutil, "rmtree", lambda *_, **__: None)  # as if it were killed

        sweep(old.folder.parent)

        assert not old.is_there

    def test_using_it_keeps_it(self, bench: Bench) -> None:
        old = self.entry(bench, "a_msgs", MONTH_S)
        old.record_use()

        sweep(old.folder.parent)

        assert old.is_there

    def test_what_was_interrupted_is_removed(self, bench: Bench) -> None:
        built = self.entry(bench, "a_msgs", 0)
        built.draft.mkdir()

        sweep(built.folder.parent)

        assert not built.draft.exists()
        assert built.is_there

    def test_what_is_being_built_is_left_alone(self, bench: Bench) -> None:
        built = self.entry(bench, "a_msgs", 0)
        built.draft.mkdir()

        with built.locked():
            sweep(built.folder.parent)

        assert built.draft.exists()
