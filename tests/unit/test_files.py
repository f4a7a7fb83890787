"""How files are written: whole or not at all, and as an editor would."""

import contextlib
import errno
import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import fourbar_codegen as fb
from fourbar_codegen.building import toolchain
from fourbar_codegen.interface import paths


@pytest.fixture(scope="module")
def runs(four_bar):
    """Of different lengths."""
    return [four_bar.simulate((0.0, 0.1), t_eval=np.linspace(0.0, 0.1, n)) for n in (2, 5, 50, 2000)]


@pytest.mark.slow(but=[".npz"])
@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_file_written_by_several_processes_is_always_whole(runs, tmp_path, ending):
    """Whoever reads finds one of the files that are written, whole."""
    path = tmp_path / f"run{ending}"
    whole = set()
    for run in runs:
        whole.add(run.save(path).read_bytes())

    def save(run):
        for _ in range(10):
            run.save(path)

    with ThreadPoolExecutor(len(runs)) as pool:
        jobs = [pool.submit(save, run) for run in runs]
        while not all(job.done() for job in jobs):
            assert path.read_bytes() in whole
        for job in jobs:
            job.result()
    assert path.read_bytes() in whole
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow(but=[".csv", ".html", ".npz", ".gif"])
@pytest.mark.parametrize("ending", [".csv", ".npz", ".nc", ".html", ".png", ".gif"])
def test_file_written_beside_others_of_similar_names_leaves_these(runs, tmp_path, ending):
    mine, path = tmp_path / f"mine{ending}.part", tmp_path / f"run{ending}"
    mine.write_text("mine")
    path.with_name(f"{path.name}.part").symlink_to(mine)  # as somebody may plant it
    before = set(tmp_path.iterdir())
    runs[0].save(path)
    runs[0].save(tmp_path / f"mine{ending}")
    assert mine.read_text() == "mine"
    assert set(tmp_path.iterdir()) == {*before, path, tmp_path / f"mine{ending}"}


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_file_that_is_replaced_keeps_its_mode(runs, tmp_path):
    old = os.umask(0o027)
    try:
        assert mode_of(runs[0].save(tmp_path / "new.csv")) == 0o640
    finally:
        os.umask(old)
    for mode in (0o600, 0o664, 0o200, 0o777):
        path = tmp_path / f"{mode:o}.csv"
        path.touch()
        path.chmod(mode)
        with paths.replacing(path) as file:
            (part,) = (other for other in tmp_path.iterdir() if other.name.startswith("."))
            assert mode_of(part) & ~mode == 0  # nor may others read it before it is there
            file.write(b"new")
        assert mode_of(path) == mode
        assert path.stat().st_size == 3


def test_file_behind_a_link_is_written_and_the_link_kept(runs, tmp_path):
    kept, link = tmp_path / "kept", tmp_path / "run.gif"
    kept.mkdir()
    link.symlink_to("kept/data.bin")
    for _ in range(2):  # there is no file at first
        assert runs[0].save(link) == link
        assert link.is_symlink()
        assert (kept / "data.bin").read_bytes().startswith(b"GIF8")
    assert {*tmp_path.iterdir(), *kept.iterdir()} == {kept, link, kept / "data.bin"}


def test_paths_that_are_no_regular_files_are_refused_and_stay(runs, tmp_path, monkeypatch):
    (tmp_path / "folder.csv").mkdir()
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "loop.csv").symlink_to("loop.csv")
    (tmp_path / "null.csv").symlink_to("/dev/null")
    (tmp_path / "protected.csv").write_text("old")
    monkeypatch.setattr(paths.os, "access", lambda path, mode: Path(path).name != "protected.csv")  # root may write all
    before = {path: path.lstat() for path in tmp_path.iterdir()}
    for path, word in zip(
        sorted(before), ("Is a directory", "Too many levels", "a device", "a device", "write-protected"), strict=True
    ):
        with pytest.raises(fb.ModelError, match=f"{path} cannot be written: .*{word}"):
            runs[0].save(path)
    assert {path: path.lstat() for path in tmp_path.iterdir()} == before
    assert Path("/dev/null").is_char_device()


def test_file_with_the_longest_name_of_the_system_is_written(runs, tmp_path):
    path = tmp_path / f"{'n' * 251}.csv"
    assert runs[0].save(path).is_file()


def test_file_is_synced_to_the_disk_before_it_replaces_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "run.csv"
    synced = []
    monkeypatch.setattr(paths.os, "fsync", lambda file: synced.append((os.fstat(file).st_size, path.exists())))
    with paths.replacing(path) as file:
        file.write(b"new")
    assert synced == [(3, False)]


@pytest.mark.slow
def test_a_module_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    folder, built = tmp_path / "folder", tmp_path / "module.so"
    built.write_bytes(b"new module")
    monkeypatch.setattr(toolchain, "_build", lambda *_, **__: built)

    def made():
        return toolchain.build_extension("module", {"module.pyx": "new"}, folder)

    made().write_bytes(b"old module")
    opened = (folder / "module.so").open("rb")  # as a process that has loaded it

    class Full:
        def __init__(self, file):
            self.file = file

        def write(self, content):
            self.file.write(content[:3])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    @contextlib.contextmanager
    def replacing(path):
        with original(path) as file:
            yield Full(file) if path.name == "module.so" else file

    original = toolchain.replacing
    with monkeypatch.context() as patch:
        patch.setattr(toolchain, "replacing", replacing)
        with pytest.raises(fb.BuildError, match=r"folder cannot be written: No space"):
            made()
    assert sorted(path.name for path in folder.iterdir()) == ["module.pyx", "module.so"]
    assert (folder / "module.so").read_bytes() == b"old module"
    assert made().read_bytes() == b"new module"
    with opened:
        assert opened.read() == b"old module"
