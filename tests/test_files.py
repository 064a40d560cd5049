import contextlib
import json
import multiprocessing
import os
import queue

import pytest

from swarmtwin.errors import UserError
from swarmtwin.files import new_folder, whole_file, write_text


def fill(path, text="new", **options):
    with new_folder(path, "test", **options) as folder:
        (folder / "content").write_text(text)


def test_a_folder_appears_whole_with_its_provenance(tmp_path):
    fill(tmp_path / "deep" / "out", config={"seed": 1})
    assert (tmp_path / "deep" / "out" / "content").read_text() == "new"
    provenance = json.loads((tmp_path / "deep" / "out" / "provenance.json").read_text())
    assert provenance["command"] == "test"
    assert provenance["config"] == {"seed": 1}
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["out"]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, OSError(28, "No space left on device")])
def test_a_failure_in_the_middle_leaves_nothing(tmp_path, failure):
    def fail():
        with new_folder(tmp_path / "out", "test") as folder:
            (folder / "half").write_text("half")
            raise failure

    with pytest.raises(failure if isinstance(failure, type) else OSError):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_a_failed_replacement_leaves_the_former_output(tmp_path):
    fill(tmp_path / "out", "former")

    def fail():
        with new_folder(tmp_path / "out", "test", overwrite=True):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert (tmp_path / "out" / "content").read_text() == "former"


def test_what_is_there_is_replaced_only_when_asked(tmp_path):
    fill(tmp_path / "out", "former")
    with pytest.raises(UserError, match="already holds something: choose another, or add overwrite=true"):
        fill(tmp_path / "out")
    fill(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "content").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_folder_of_the_users_own_is_never_replaced(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1").write_text("years of work")
    with pytest.raises(UserError, match="was not made by swarmtwin, so overwrite=true leaves it alone"):
        fill(tmp_path / "thesis", overwrite=True)
    assert (tmp_path / "thesis" / "chapter1").read_text() == "years of work"


def test_what_another_command_made_is_never_replaced(tmp_path):
    fill(tmp_path / "out")
    refused = pytest.raises(UserError, match="was made by swarmtwin test, so overwrite=true leaves it alone")
    with refused, new_folder(tmp_path / "out", "other", overwrite=True):
        pass
    assert (tmp_path / "out" / "content").read_text() == "new"


@pytest.mark.parametrize(("output", "what"), [("in", "replace"), (".", "replace"), ("in/side", "lie inside")])
def test_an_output_keeps_clear_of_the_inputs(tmp_path, output, what):
    (tmp_path / "in").mkdir()
    with pytest.raises(UserError, match=f"would {what} the input"):
        fill(tmp_path / output, overwrite=True, inputs=[tmp_path / "in"])
    assert list((tmp_path / "in").iterdir()) == []


def test_a_kill_between_the_two_renames_of_a_replacement_is_mended(tmp_path):
    fill(tmp_path / "out", "former")
    (tmp_path / "out").rename(tmp_path / ".out.former.partial")
    with pytest.raises(UserError, match="already holds something"):
        fill(tmp_path / "out")
    assert (tmp_path / "out" / "content").read_text() == "former"


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(UserError, match="is not a folder: name another"):
        fill(tmp_path / "out")


def test_unfinished_work_is_kept_aside_and_found_again(tmp_path, caplog):
    """Its checkpoints alone: what else it had written may be of other options; both times a person is told."""

    def interrupted():
        with new_folder(tmp_path / "out", "test", resumable=True) as folder:
            (folder / "picture").write_text("of the call that was interrupted")
            (folder / "checkpoints" / "seed-1").write_text("epoch 3")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"what was done is kept, the same call with output=.*out goes on"):
        interrupted()
    assert not (tmp_path / "out").exists()
    with (
        caplog.at_level("INFO"),
        new_folder(tmp_path / "out", "test", resumable=True) as folder,
    ):
        assert (folder / "checkpoints" / "seed-1").read_text() == "epoch 3"
    assert "goes on with what an interrupted call has left" in caplog.text
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["provenance.json"]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt])
def test_where_nothing_was_done_yet_nothing_is_kept_or_promised(tmp_path, failure):
    with pytest.raises(failure, match=r"^$"), new_folder(tmp_path / "out", "test", resumable=True):
        raise failure
    assert list(tmp_path.iterdir()) == []


def test_what_a_kill_left_beside_a_whole_output_is_cleared_away(tmp_path):
    """Also where the next call is refused."""
    fill(tmp_path / "out")
    (tmp_path / ".out.former.partial").mkdir()
    (tmp_path / ".out.lock.partial").touch()
    with pytest.raises(UserError, match="already holds something"):
        fill(tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def hold(path, started, release):
    with new_folder(path, "test"):
        started.set()
        release.wait(20)


def test_two_processes_do_not_write_one_folder(tmp_path):
    context = multiprocessing.get_context("spawn")
    started, release = context.Event(), context.Event()
    process = context.Process(target=hold, args=(tmp_path / "out", started, release))
    process.start()
    assert started.wait(20)
    with pytest.raises(UserError, match="another process is writing"):
        fill(tmp_path / "out")
    release.set()
    process.join()
    assert (tmp_path / "out" / "provenance.json").exists()


def test_a_text_is_replaced_whole(tmp_path):
    write_text(tmp_path / "table.csv", "a")
    write_text(tmp_path / "table.csv", "b")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["b"]


def test_files_can_be_read_by_those_whom_the_umask_lets(tmp_path):
    before = os.umask(0o027)
    try:
        with whole_file(tmp_path / "weights") as aside:
            os.close(os.open(aside, os.O_CREAT | os.O_WRONLY, 0o600))
    finally:
        os.umask(before)
    assert (tmp_path / "weights").stat().st_mode & 0o777 == 0o640


def take(folder, number, done):
    for _ in range(40):
        with contextlib.suppress(UserError), new_folder(folder, "test", overwrite=True) as inside:
            (inside / "mine").write_text(str(number))
            assert [file.name for file in inside.iterdir() if file.name != "provenance.json"] == ["mine"]
            done.put(number)


def test_an_output_never_has_two_writers(tmp_path):
    """A lock that is removed while another process opens it is not taken for one's own."""
    fork = multiprocessing.get_context("fork")
    done = fork.Queue()
    processes = [fork.Process(target=take, args=(tmp_path / "out", number, done)) for number in range(6)]
    for process in processes:
        process.start()
    written = 0
    while any(process.is_alive() for process in processes) or not done.empty():
        with contextlib.suppress(queue.Empty):
            done.get(timeout=0.1)
            written += 1
    assert [process.exitcode for process in processes] == [0] * 6
    assert written >= 6
    assert not list(tmp_path.glob(".*"))
