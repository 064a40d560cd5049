import multiprocessing
import shutil
import subprocess
import sys

import pytest

from swarmtwin.errors import UserError
from swarmtwin.files import folder_digest
from swarmtwin.tracking import registry
from swarmtwin.tracking.runs import tracked_run

NAME = "mgr-dynamics"
FORK = multiprocessing.get_context("fork")


@pytest.fixture
def publish(workplace):
    """Register a model whose content is `text`, as a command that trained it would."""

    def register(text):
        folder = workplace / f"model_{text}"
        folder.mkdir(exist_ok=True)
        (folder / "model.yaml").write_text(text)
        with tracked_run("dynamics", text, {}) as run:
            source = run.folder(folder, "model")
        return registry.register(NAME, folder, source, run.run_id, {"model": "mlp"})

    return register


def test_the_newest_version_is_the_challenger_and_its_files_come_back(publish):
    first, second = publish("one"), publish("two")
    assert (first.number, second.number) == (1, 2)
    assert registry.find_version(f"models:/{NAME}@challenger").number == 2
    assert (registry.model_folder(f"models:/{NAME}/1") / "model.yaml").read_text() == "one"
    assert registry.find_version(f"models:/{NAME}/1").tags["model"] == "mlp"
    assert registry.champion(NAME) is None


def test_a_version_is_found_by_its_content(publish, workplace):
    publish("one")
    publish("two")
    assert registry.version_of(NAME, workplace / "model_one").number == 1
    (workplace / "model_one" / "model.yaml").write_text("changed")
    assert registry.version_of(NAME, workplace / "model_one") is None


def test_champions_follow_each_other_and_roll_back_in_order(publish):
    for text in ("one", "two", "three"):
        registry.promote(publish(text), "better", registry.champion(NAME))
    assert registry.champion(NAME).number == 3
    assert registry.roll_back(NAME) == (3, 2)
    assert registry.roll_back(NAME) == (2, 1)
    assert registry.champion(NAME).number == 1
    with pytest.raises(UserError, match="version 1 is the first champion: there is none to roll back to"):
        registry.roll_back(NAME)
    assert registry.champion(NAME).number == 1


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("models:/mgr", "'models:/mgr' names no model: write models:/NAME@ALIAS or models:/NAME/VERSION"),
        ("models:/mur-dynamics/1", "no registered model 'mur-dynamics'; registered: mgr-dynamics"),
        ("models:/mgr-dynamics/7", "no such version; there are 1 (@challenger)"),
        ("models:/mgr-dynamics@champion", "no such version; there are 1 (@challenger)"),
        ("nowhere", "no model folder nowhere: give a folder, models:/NAME@ALIAS or models:/NAME/VERSION"),
    ],
)
def test_a_wrong_reference_says_what_there_is(publish, reference, message):
    publish("one")
    with pytest.raises(UserError) as error:
        registry.model_folder(reference)
    assert message in str(error.value)


def test_a_version_whose_files_are_gone_is_not_blamed_on_the_store(publish):
    shutil.rmtree(publish("one").source.removeprefix("file://"))
    with pytest.raises(UserError, match=r"^the files of mgr-dynamics version 1 are not where .* says"):
        registry.model_folder(f"models:/{NAME}/1")


def test_without_any_model_the_remedy_is_to_train_one(workplace):
    with pytest.raises(UserError, match="registered: none yet: train one first"):
        registry.find_version("models:/mgr-dynamics@champion")
    with pytest.raises(UserError, match="has no champion to roll back from"):
        registry.roll_back(NAME)


def test_files_that_were_changed_are_refused_with_both_digests(publish):
    version = publish("one")
    file = version.folder() / "model.yaml"
    file.write_text("two")
    with pytest.raises(UserError, match=r"version 1 in .* are not those that were registered: their digest is") as told:
        registry.model_folder(f"models:/{NAME}/1")
    assert version.tags["digest"] in str(told.value)
    assert folder_digest(file.parent) in str(told.value)
    file.write_text("one")
    assert registry.model_folder(f"models:/{NAME}/1") == file.parent


def test_a_champion_that_was_not_compared_with_is_not_replaced(publish):
    first, second, third = publish("one"), publish("two"), publish("three")
    registry.promote(first, "the first", None)
    registry.promote(second, "better", first)
    with pytest.raises(UserError, match="version 2 became champion meanwhile: promote mgr-dynamics version 3 again"):
        registry.promote(third, "better than version 1", first)
    assert registry.champion(NAME).number == 2


@pytest.mark.parametrize("change", ["promotion", "rollback"])
def test_a_kill_in_the_middle_of_a_change_of_champions_leaves_the_history_right(publish, monkeypatch, change):
    """Between what is remembered and who is champion: called again, the change is whole, and no champion is twice."""
    first, second, third = publish("one"), publish("two"), publish("three")
    registry.promote(first, "the first", None)
    registry.promote(second, "better", first)
    half = {"promotion": "set_registered_model_alias", "rollback": "set_registered_model_tag"}[change]
    with monkeypatch.context() as patch:
        patch.setattr(f"mlflow.MlflowClient.{half}", fail)
        with pytest.raises(KeyboardInterrupt):
            registry.promote(third, "best", second) if change == "promotion" else registry.roll_back(NAME)
    if change == "promotion":
        registry.promote(third, "best", second)
        assert registry.roll_back(NAME) == (3, 2)
        assert registry.roll_back(NAME) == (2, 1)
    assert registry.champion(NAME).number == 1
    with pytest.raises(UserError, match="is the first champion"):
        registry.roll_back(NAME)


def fail(*arguments):
    raise KeyboardInterrupt


def promote_until_it_is_champion(number):
    """Be promoted against whoever is champion, again and again until that is still true."""
    version = registry.find_version(f"models:/{NAME}/{number}")
    while True:
        try:
            registry.promote(version, "better", registry.champion(NAME))
            return
        except UserError as error:
            if "meanwhile" not in str(error):
                raise


def test_of_promotions_at_once_none_is_missing_in_the_history(publish):
    numbers = [publish(str(index)).number for index in range(12)]
    processes = [FORK.Process(target=promote_until_it_is_champion, args=(number,)) for number in numbers]
    _at_once(processes)
    passed = [registry.champion(NAME).number]
    for _ in numbers[1:]:
        passed.append(registry.roll_back(NAME)[1])
    assert sorted(passed) == numbers
    with pytest.raises(UserError, match="is the first champion"):
        registry.roll_back(NAME)


def train_nothing(number, workplace):
    folder = workplace / f"model_{number}"
    folder.mkdir()
    (folder / "model.yaml").write_text(str(number))
    with tracked_run("dynamics", str(number), {"output": str(number)}) as run:
        run.metrics({"position_mm": number})
        source = run.folder(folder, "model")
    registry.register(NAME, folder, source, run.run_id, {})


def test_writers_on_a_new_database_all_succeed(workplace):
    _at_once([FORK.Process(target=train_nothing, args=(number, workplace)) for number in range(16)])
    assert sorted(version.number for version in registry.versions(NAME)) == list(range(1, 17))


def _at_once(processes):
    for process in processes:
        process.start()
    for process in processes:
        process.join(timeout=120)
    assert [process.exitcode for process in processes] == [0] * len(processes)


FULL_DISK = """
import logging, os, sys, time
from pathlib import Path
os.chdir(sys.argv[1])
from swarmtwin.files import new_folder
from swarmtwin.tracking import registry
from swarmtwin.tracking.runs import tracked_run

logging.basicConfig(level=logging.WARNING)


def fill():
    with open("filler", "wb", buffering=0) as filler:
        for size in (65536, 4096, 1):
            try:
                while True:
                    filler.write(bytes(size))
            except OSError:
                pass


def learn(full):
    inside = new_folder(Path("out"), "train", resumable=True, overwrite=True)
    with inside as folder, tracked_run("dynamics", full, {"output": "out"}) as run:
        (folder / "checkpoints" / "seed-1").write_text("epoch 3")
        (folder / "model.yaml").write_text("a model" * 1000)
        if full == "files":
            fill()
        source = run.folder(folder, "model")
        if full == "registration":
            fill()
        registry.register("mgr-dynamics", folder, source, run.run_id, {})
        if full == "end":
            fill()


for full in ("files", "registration", "end"):
    started = time.monotonic()
    try:
        learn(full)
    except OSError as error:
        assert error.errno == 28, error
    else:
        raise AssertionError(full)
    assert time.monotonic() - started < 10
    assert Path(".out.partial/checkpoints/seed-1").exists()
    Path("filler").unlink()
    learn("room")
    assert sorted(path.name for path in Path("out").iterdir()) == ["model.yaml", "provenance.json"]
    for version in registry.versions("mgr-dynamics"):
        version.folder()
    assert registry.find_version("models:/mgr-dynamics@challenger").folder()
print("done")
"""


def test_a_full_disk_in_the_middle_leaves_nothing_half_and_the_same_call_goes_on(workplace):
    """On a small file system of the test's own."""
    (workplace / "learn.py").write_text(FULL_DISK)
    (workplace / "disk").mkdir()
    mount = f"mount -t tmpfs -o size=4M none {workplace / 'disk'}"
    inside = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c")
    if not shutil.which("unshare") or subprocess.run([*inside, mount], capture_output=True, check=False).returncode:
        pytest.skip("no file system can be mounted here")
    script = f"{mount} && exec {sys.executable} {workplace / 'learn.py'} {workplace / 'disk'}"
    answer = subprocess.run([*inside, script], capture_output=True, text=True, check=False)
    assert answer.stdout == "done\n", answer.stderr
    assert "Traceback" not in answer.stderr
