from __future__ import annotations

import os
from pathlib import Path

import pytest

from poet_loc.core.input_error import InputError
from poet_loc.io.whole_folder import whole_folder, write_whole_file


def contents(folder: Path) -> dict[str, str]:
    return {str(file.relative_to(folder)): file.read_text() for file in folder.rglob("*") if file.is_file()}


def test_a_new_folder_appears_at_success_only(tmp_path):
    target = tmp_path / "a" / "b" / "run"
    with whole_folder(target) as folder:
        assert folder.parent == target.parent
        (folder / "sub").mkdir()
        (folder / "sub" / "x").write_text("new")
        assert not target.exists()
    assert contents(tmp_path) == {"a/b/run/sub/x": "new"}
    assert target.stat().st_mode & 0o777 == 0o777 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_an_empty_folder_is_taken(tmp_path):
    (tmp_path / "run").mkdir()
    with whole_folder(tmp_path / "run") as folder:
        (folder / "x").write_text("new")
    assert contents(tmp_path) == {"run/x": "new"}


@pytest.mark.parametrize("stop", [ValueError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("overwrite", [False, True])
def test_an_interruption_leaves_everything_as_it_was(tmp_path, stop, overwrite):
    target = tmp_path / "run"
    if overwrite:
        target.mkdir()
        (target / "old").write_text("old")

    def work() -> None:
        with whole_folder(target, overwrite) as folder:
            (folder / "half").write_text("half")
            raise stop

    with pytest.raises(stop):
        work()
    assert contents(tmp_path) == ({"run/old": "old"} if overwrite else {})
    assert sorted(path.name for path in tmp_path.iterdir()) == (["run"] if overwrite else [])


def test_results_are_not_overwritten_unless_asked(tmp_path):
    target = tmp_path / "run"
    target.mkdir()
    (target / "old").write_text("old")
    with pytest.raises(InputError) as caught, whole_folder(target):
        pytest.fail("the block must not run")
    assert str(caught.value) == f"{target}: has results; choose another --out or pass --overwrite"
    with whole_folder(target, overwrite=True) as folder:
        (folder / "new").write_text("new")
    assert contents(tmp_path) == {"run/new": "new"}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_old_folder_comes_back_where_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    target = tmp_path / "run"
    target.mkdir()
    (target / "old").write_text("old")
    rename = Path.rename

    def fail_for_the_new_one(self, place):
        if self.suffix == ".partial":
            raise OSError("no")
        return rename(self, place)

    monkeypatch.setattr(Path, "rename", fail_for_the_new_one)
    with pytest.raises(OSError, match="no"), whole_folder(target, overwrite=True) as folder:
        (folder / "new").write_text("new")
    assert contents(tmp_path) == {"run/old": "old"}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_file_in_the_way(tmp_path):
    (tmp_path / "run").write_text("x")
    with pytest.raises(InputError, match="is a file"), whole_folder(tmp_path / "run", overwrite=True):
        pytest.fail("the block must not run")
    with pytest.raises(InputError, match="cannot be written"), whole_folder(tmp_path / "run" / "deeper"):
        pytest.fail("the block must not run")


def test_neither_input_nor_working_folder_is_replaced(tmp_path, monkeypatch):
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "imu.csv").write_text("x")
    with pytest.raises(InputError, match="holds the input"), whole_folder(tmp_path, True, [tmp_path / "log"]):
        pytest.fail("the block must not run")
    monkeypatch.chdir(tmp_path / "log")
    with pytest.raises(InputError, match="working"), whole_folder(tmp_path, overwrite=True):
        pytest.fail("the block must not run")
    assert contents(tmp_path) == {"log/imu.csv": "x"}


def test_relative_target_and_symbolic_link(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "old").write_text("old")
    (tmp_path / "link").symlink_to("real")
    with whole_folder("link", overwrite=True) as folder:
        (folder / "new").write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert contents(tmp_path / "real") == {"new": "new"}


def test_a_file_is_whole_or_as_it_was(tmp_path):
    path = tmp_path / "x.csv"
    write_whole_file(path, ["a", "b"])

    def parts():
        yield "c"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole_file(path, parts())
    assert contents(tmp_path) == {"x.csv": "ab"}
    with pytest.raises(InputError, match="cannot be written"):
        write_whole_file(tmp_path / "nowhere" / "x.csv", ["a"])
