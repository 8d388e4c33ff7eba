"""Model files: the extension chooses the format; a file is written whole or not at all."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import pytest

from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.formats import FORMATS, Document, files, read, read_native, template, write
from factored_polca.models import Action, Feature, Model, ModelError, Task, TaskHierarchy


def corridor() -> Model:
    return Model(
        "corridor", [Feature("x", range(3))], [Action("a", {"x": "min(x + 1, 2)"})], discount="0.9"
    )


@pytest.mark.parametrize("name", ["model.toml", "MODEL.TOML", "a.b.Toml"])
def test_a_native_file_is_known_by_its_extension_in_any_case(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(template("porter"), encoding="utf-8")
    assert read(path) == read(str(path)) == read_native(template("porter"))
    assert read(path, {"slip": "1/4"}).model.parameters == (("slip", Fraction(1, 4)),)


def test_a_model_without_a_name_is_called_as_its_file(tmp_path: Path) -> None:
    path = tmp_path / "lift.toml"
    path.write_text("discount = 0.5\n[features]\nx = 'boolean'\n[actions.a]\n")
    assert read(path).model.name == "lift"


@pytest.mark.parametrize(("name", "found"), [("model.yaml", "'.yaml'"), ("model", "without an extension")])
def test_an_unknown_extension_lists_those_there_are(tmp_path: Path, name: str, found: str) -> None:
    for action in (lambda: read(tmp_path / name), lambda: write(corridor(), tmp_path / name)):
        with pytest.raises(ModelError) as caught:
            action()
        message = str(caught.value)
        assert found in message
        assert all(extension in message for extension in FORMATS)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"nowhere\.toml: there is no such file \(formats are \.toml"):
        read(tmp_path / "nowhere.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(ModelError, match=r"folder\.toml: the file can't be read: Is a directory"):
        read(tmp_path / "folder.toml")
    with pytest.raises(ModelError, match="can't be read: embedded null byte"):
        read("a\0.toml")


def test_bytes_that_are_no_text_are_found_at_their_place(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_bytes("name = 'x'\né = ".encode() + b"\xff\n")
    with pytest.raises(ModelError, match=r"m\.toml:2:5: the byte 0xff is no UTF-8"):
        read(path)


def test_a_file_beyond_the_cap_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAXIMUM_BYTES", 100)
    path = tmp_path / "m.toml"
    path.write_bytes(b"#" * 101)
    with pytest.raises(ModelError, match="more than 100 bytes"):
        read(path)


def test_every_fault_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text("discount = 2\nfoo = 1\n")
    with pytest.raises(ModelError) as caught:
        read(path)
    assert len(caught.value.faults) == 4
    assert all(str(fault).startswith(str(path)) for fault in caught.value.faults)
    assert f"{path}:2:1: foo: unknown key 'foo'" in str(caught.value)


def test_a_written_file_is_read_back(tmp_path: Path) -> None:
    tasks = TaskHierarchy([Task("T", ["a"])])
    write(corridor(), tmp_path / "m.toml", tasks)
    assert read(tmp_path / "m.toml") == Document(corridor(), tasks)
    write(Document(corridor(), tasks), str(tmp_path / "n.toml"))
    assert (tmp_path / "n.toml").read_bytes() == (tmp_path / "m.toml").read_bytes()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["m.toml", "n.toml"]


def test_writing_keeps_the_mode_of_a_file_and_follows_links(tmp_path: Path) -> None:
    target, link = tmp_path / "m.toml", tmp_path / "link.toml"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    write(corridor(), link)
    assert link.is_symlink()
    assert read(target).model == corridor()
    assert target.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_while_writing_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    path = tmp_path / "m.toml"
    path.write_text("old")

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(ModelError if isinstance(error, OSError) else KeyboardInterrupt):
        write(corridor(), path)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["m.toml"]


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"there is no folder .*nowhere"):
        write(corridor(), tmp_path / "nowhere" / "m.toml")


def test_spudd_files_are_read_and_written_too(tmp_path: Path) -> None:
    light = Feature("light", ["off", "on"])
    switch = Action("switch", {light: "{on: 0.9, off: 0.1} if light == off else off"})
    model = Model("lamp", [light], [switch], rewards="1 if light == on else 0", discount="0.9")
    for name in ("lamp.dat", "lamp.SPUDD"):
        write(model, tmp_path / name)
        back = read(tmp_path / name)
        assert back.tasks is None
        assert back.model.name == "lamp"
        assert back.model.features == model.features
        ours, theirs = enumerate_model(model), enumerate_model(back.model)
        assert theirs.rows == ours.rows
        assert theirs.rewards == ours.rewards


@pytest.mark.parametrize("name", ["m.dat", "m.spudd"])
def test_spudd_files_refuse_what_they_cannot_hold(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with pytest.raises(ModelError, match="can't hold tasks"):
        write(corridor(), path, TaskHierarchy([Task("T", ["a"])]))
    path.write_text("")
    with pytest.raises(ModelError, match=r"no parameters to set \(slip\)"):
        read(path, {"slip": "0.2"})
    assert path.read_text() == ""
